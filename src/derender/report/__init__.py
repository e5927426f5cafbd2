"""Stage 9: results as images and pages.

colours       values to 8-bit images
panel         labelled grids of images
figures       a decomposition as images
films         the light going round, the object turning; as PNG, GIF and MP4
sweeps        one scene in many lights, from many sides, with parts of another
texture       albedo from the image itself
mesh          a scene's surface for other programs; mesh_files: GLB and OBJ
sheets        contact sheets over many images
charts        curves and bars as SVG
score_table   scores beside controls as a value
blocks, page  one self-contained HTML file
files, moved  a decomposition, and sweeps and swaps, on disk
run           the page of a training run
viewer/       the page one can play with, and its server
"""
