"""The official training step's arithmetic, done literally: what derender's own step is timed against.

Written from the published description of networks and losses, not from anybody's code. It shares only the
renderer with derender, so that the comparison says nothing about rasterisers.
"""
