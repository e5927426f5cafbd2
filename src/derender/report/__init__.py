"""Stage 9: results as images and pages.

colours       values to 8-bit images
panel         labelled grids of images
decomposition  a decomposition as images
sweeps        one scene in many lights, from many sides, with parts of another; as PNG, GIF and MP4
mesh          a scene's surface for other programs
options, opening, edits, editing  images opened, edited and written to disk
charts        curves and bars as SVG; matrices
page          one self-contained HTML file, made of templates/
run, explanation, protocols  the pages
viewer/       the page one can play with, and its server
"""
