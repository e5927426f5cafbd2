"""Stage 9: results as pictures and pages.

colours       values to 8-bit images
panel         labelled grids of images
figures       a decomposition as images
films         the light going round, the object turning
charts        curves and bars as SVG
score_table   scores beside controls as a value
blocks, page  one self-contained HTML file
files, run    a decomposition on disk; the page of a training run
"""
