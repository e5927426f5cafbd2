"""Photographs: the part that suits a model, edits in their own detail, and the way back into the whole.

edit          relight, rotate: one call from a photograph to a photograph; decompose, to its scene
detail        drawing a photograph's scene with the photograph's own pixels
video         a video in, a video out
frame         a square cut out of a photograph, and put back
align         every face of a folder, cut out upright
faces         faces found, and the frame that a face model knows
"""

from derender.photo.align import Aligned, align
from derender.photo.detail import PhotoDetail
from derender.photo.edit import (
    Photograph,
    decompose,
    editable_scenes,
    editing_steps,
    found_frame,
    open_photograph,
    relight,
    rotate,
)
from derender.photo.faces import Face, face_candidates, find_faces
from derender.photo.frame import Frame
from derender.photo.video import EditedVideo, edit_video, is_video

__all__ = [
    "Aligned", "EditedVideo", "Face", "Frame", "PhotoDetail", "Photograph", "align", "decompose",
    "edit_video", "editable_scenes", "editing_steps", "face_candidates", "find_faces", "found_frame",
    "is_video", "open_photograph", "relight", "rotate",
]  # fmt: skip
