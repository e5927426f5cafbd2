"""Says whether a set of pictures suits the method, before anyone trains.

originals    sizes and shapes of the files, from their headers
pixels       brightness, clipping, colour, and the small descriptors that everything else is measured on
near_copies  pictures that differ by a little shift, brightness or compression only
structure    what the pictures share at the same place: agreement, symmetry, extent, middle
kinds        one kind of thing or two; pictures unlike all others
variety      variety of view and of light
estimate     a value and its standard error; limits  where each measure turns bad, in one table
measures     all of it joined; findings  from measures to sentences and a verdict
examine      a set of pictures in, an examination out
"""

from derender.data.doctor.estimate import Estimate
from derender.data.doctor.examine import EXAMINED_PX, Examination, examine
from derender.data.doctor.findings import Finding, Level, Verdict
from derender.data.doctor.measures import Measures
from derender.data.doctor.originals import Originals, measure_originals

__all__ = [
    "EXAMINED_PX",
    "Estimate",
    "Examination",
    "Finding",
    "Level",
    "Measures",
    "Originals",
    "Verdict",
    "examine",
    "measure_originals",
]
