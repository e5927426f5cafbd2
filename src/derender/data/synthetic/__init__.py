"""Built-in pictures with exact ground truth: a procedural face generator that needs no download.

``faces.generate`` makes them, ``write`` saves them in the layout of the rendered data sets.
"""

from derender.data.synthetic import faces
from derender.data.synthetic.settings import FaceSettings
from derender.data.synthetic.synthetic_set import SyntheticSet
from derender.data.synthetic.write import write

__all__ = ["FaceSettings", "SyntheticSet", "faces", "write"]
