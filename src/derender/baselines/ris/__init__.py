"""Retrieve in Style: which numbers of a generator's style space paint which part of a picture.

catalogue: clusters of activations, their parts, and the matrix of parts and channels; model: features by
part; building: a catalogue from a generator and pictures with masks.
"""
