"""The page one can play with: a server on this machine, and what it serves.

questions   what a page may ask, checked
refused     an answer that is no, with its HTTP status
shelf       the pictures that were opened last, taken apart, in memory only
bodies      what arrives, within one bound for all uploads
intake      bytes from a stranger to pixels
examples    pictures to begin with
neighbours  rows of a feature table near to a picture, with their pictures
studio      a question to images, meshes and archives: no word of HTTP
guard       whom the server answers: hosts, origins, headers
app         addresses and time limits
listener    a socket; server: uvicorn on it
page/       HTML, CSS and JavaScript, which need nothing from elsewhere

Guard, app and server need starlette and uvicorn (``pip install 'derender[view]'``). The API is the page's own
and no promise to anybody else. Leaves out several models at once and anything kept on disk.
"""
