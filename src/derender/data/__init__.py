"""Pictures in: folders, zips and published data sets, decoded once into one array.

source      files of a folder (listing: of a very large one, remembered), a zip, or one picture
zip_directory, zip_member, zip_listing  a zip's members without an object for each, read at their places
names       which names count; kept: what is remembered between starts
stream/     what comes one after another: WebDataset shards, Hugging Face data sets
layout      what a data set's layout is; registry lists them, one or a few in a file: celeba, celebamask,
            emotions, faces, tracks, cars, rendered, tables, folders
masks       pictures with a mask each: read_masks
inventory   files and labels, nothing decoded
decode      one picture; loading: all, on every core; duplicates; cache: large sets in a memory map
pictures    all of it joined: read_pictures
splits      which rows are for training, validation, test
ground_truth  the exact maps of rendered sets
"""

from derender.data.celebamask import MASK_CLASSES
from derender.data.decode import Unreadable, read_picture
from derender.data.duplicates import Duplicate
from derender.data.ground_truth import GroundTruth, read_ground_truth
from derender.data.inventory import Inventory, take_inventory
from derender.data.masks import MaskedPictures, read_masks
from derender.data.pictures import PictureSet, as_float, read_pictures
from derender.data.places import cache_folder
from derender.data.registry import LAYOUTS
from derender.data.source import Skipped
from derender.data.splits import Split, split_indices

__all__ = [
    "LAYOUTS",
    "MASK_CLASSES",
    "Duplicate",
    "GroundTruth",
    "Inventory",
    "MaskedPictures",
    "PictureSet",
    "Skipped",
    "Split",
    "Unreadable",
    "as_float",
    "cache_folder",
    "read_ground_truth",
    "read_masks",
    "read_picture",
    "read_pictures",
    "split_indices",
    "take_inventory",
]
