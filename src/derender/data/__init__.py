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

from derender.data.cache import sample_checksum
from derender.data.celebamask import MASK_CLASSES
from derender.data.checks import check_pictures, refuse_not_finite
from derender.data.decode import READER_VERSION, Unreadable, decode, quiet_pillow, read_picture
from derender.data.duplicates import Duplicate
from derender.data.ground_truth import GroundTruth, read_ground_truth
from derender.data.inventory import Inventory, parse_source, take_inventory
from derender.data.loading import Progress, usable_cores
from derender.data.mask_folder import read_mask_folder
from derender.data.masks import MaskedPictures, read_masks
from derender.data.names import is_picture, suggestion
from derender.data.parquet_claims import check_lists, checked_footer
from derender.data.pictures import PictureSet, as_float, read_pictures
from derender.data.places import cache_folder
from derender.data.registry import LAYOUTS
from derender.data.source import Skipped, nearest_sibling, open_source
from derender.data.splits import Split, split_indices
from derender.data.stream.address import open_stream
from derender.data.stream.collect import estimated_total
from derender.data.stream.decoding import Decoded, ahead, decode_samples, decoded
from derender.data.stream.labels import Kind, Kinds, column_of
from derender.data.stream.listed import ListedStream, stream_of
from derender.data.stream.sample import Sample, Stream, Value
from derender.data.stream.seen import SeenPixels

__all__ = [
    "LAYOUTS",
    "MASK_CLASSES",
    "READER_VERSION",
    "Decoded",
    "Duplicate",
    "GroundTruth",
    "Inventory",
    "Kind",
    "Kinds",
    "ListedStream",
    "MaskedPictures",
    "PictureSet",
    "Progress",
    "Sample",
    "SeenPixels",
    "Skipped",
    "Split",
    "Stream",
    "Unreadable",
    "Value",
    "ahead",
    "as_float",
    "cache_folder",
    "check_lists",
    "check_pictures",
    "checked_footer",
    "column_of",
    "decode",
    "decode_samples",
    "decoded",
    "estimated_total",
    "is_picture",
    "nearest_sibling",
    "open_source",
    "open_stream",
    "parse_source",
    "quiet_pillow",
    "read_ground_truth",
    "read_mask_folder",
    "read_masks",
    "read_picture",
    "read_pictures",
    "refuse_not_finite",
    "sample_checksum",
    "split_indices",
    "stream_of",
    "suggestion",
    "take_inventory",
    "usable_cores",
]
