"""Where each measure turns bad: every threshold of the doctor, once.

Chosen on one half of the material of docs/doctor.md and checked on the other; the margins stand there. Those
marked (*) are conventions: nothing was measured to set them.
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class Limits:
    """Past an ``objects`` limit a set does not suit, past a ``struggles`` limit the method will struggle.

    Attributes:
        copy_correlation: 16 x 16 grey versions that correlate by this much or more are near copies.
        distinct_objects, distinct_struggles: distinct pictures (*).
        copies_struggles: share of copies and near copies.
        unreadable_struggles: share of files that cannot be read (*).
        small_struggles: share of files smaller than the examined size (*).
        agreement_objects, agreement_struggles: see structure.py.
        symmetry_objects, symmetry_struggles: see structure.py.
        axis_struggles: distance of the axis of symmetry from the middle, as a share of the width.
        axis_symmetric: both sides about an axis correlate by this much where it is one.
        fill_struggles: share of the frame with common structure.
        kinship_objects: see kinds.py.
        odd_likeness, odd_struggles: a picture less like the others than this is odd; share of odd pictures.
        view_flat: view variety below this is none.
        light_flat, light_struggles: light variety below these is none, or little.
        clipped_struggles: mean share of pixels that are black or white (*).
        note_share: small, oblong, grey or clipped: a share above this is worth a note (*).
    """

    copy_correlation: float = 0.98
    distinct_objects: int = 100
    distinct_struggles: int = 1000
    copies_struggles: float = 0.3
    unreadable_struggles: float = 0.2
    small_struggles: float = 0.5
    agreement_objects: float = 0.10
    agreement_struggles: float = 0.18
    symmetry_objects: float = 0.6
    symmetry_struggles: float = 0.85
    axis_struggles: float = 0.06
    axis_symmetric: float = 0.7
    fill_struggles: float = 0.56
    kinship_objects: float = 0.45
    odd_likeness: float = 0.15
    odd_struggles: float = 0.05
    view_flat: float = 0.72
    light_flat: float = 0.015
    light_struggles: float = 0.035
    clipped_struggles: float = 0.3
    note_share: float = 0.1


LIMITS = Limits()
