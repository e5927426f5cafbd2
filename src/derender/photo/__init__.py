"""Photographs: the part that suits a model, edits in their own detail, and the way back into the whole.

edit          relight, rotate: one call from a photograph to a photograph
detail        drawing a photograph's scene with the photograph's own pixels
frame         a square cut out of a photograph, and put back
faces         faces found, and the frame that a face model knows
"""

from derender.photo.detail import PhotoDetail
from derender.photo.edit import Photograph, found_frame, open_photograph, relight, rotate
from derender.photo.faces import Face, find_faces
from derender.photo.frame import Frame

__all__ = [
    "Face",
    "Frame",
    "PhotoDetail",
    "Photograph",
    "find_faces",
    "found_frame",
    "open_photograph",
    "relight",
    "rotate",
]
