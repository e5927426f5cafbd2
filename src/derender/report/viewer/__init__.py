"""The interactive page: a server on this machine, and the page's own files.

questions   requests of the page, checked; uploads to pixels
studio      requests to images, meshes and archives, without HTTP
images      opened images, in memory only; examples; rows of a feature table near to an image
app         addresses, and bounds on size and time
server      a socket, and uvicorn on it; requests that it accepts, and their bodies
page/       HTML, CSS and JavaScript, which need nothing from elsewhere

App and server need starlette and uvicorn (``pip install 'derender[view]'``). The API is the page's own
and may change. Leaves out several models at once and anything stored on disk.
"""
