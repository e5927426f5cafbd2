"""Images in: folders, zips, shards and published data sets, decoded once into one array or streamed.

opening       from what the user wrote to a stream of images: open_images
source        named files, in folders and zips; parquet files, their sizes checked before they are read
layouts/      how data sets lie: recognised, and read into a table of files and labels
stream        images one after another, decoded on every core; streamed: WebDataset, Hugging Face
image         decode one; images as a caller has them
image_set     a stream collected into an array: read_images; its split; cache: large sets in a memory map
maps          images with masks, with exact depth, normals and albedo
doctor/       whether a set of images suits the method
"""

from derender.data.cache import cache_folder
from derender.data.image import (
    GivenImages,
    Unreadable,
    as_batch,
    as_photos,
    check_images,
    decode,
    decode_whole,
    quiet_pillow,
    read_image,
    read_photo,
)
from derender.data.image_set import Duplicate, ImageSet, Split, as_float, read_images, split_indices
from derender.data.layouts import LAYOUTS
from derender.data.layouts.faces import MASK_CLASSES
from derender.data.layouts.layout import half_of, missing
from derender.data.maps import GroundTruth, MaskedImages, read_ground_truth, read_masks
from derender.data.opening import ListedStream, list_images, open_images, open_source, parse_source
from derender.data.source import Skipped, is_image, opened_parquet
from derender.data.stream import Progress, Sample, Stream, estimated_total, usable_cores
from derender.storage.places import nearest_sibling, suggestion

__all__ = [
    "LAYOUTS", "MASK_CLASSES", "Duplicate", "GivenImages", "GroundTruth", "ImageSet", "ListedStream",
    "MaskedImages", "Progress", "Sample", "Skipped", "Split", "Stream", "Unreadable", "as_batch",
    "as_float", "as_photos", "cache_folder", "check_images", "decode", "decode_whole",
    "estimated_total", "half_of", "is_image", "list_images", "missing", "nearest_sibling",
    "open_images", "open_source", "opened_parquet", "parse_source", "quiet_pillow", "read_ground_truth",
    "read_image", "read_images", "read_masks", "read_photo", "split_indices", "suggestion",
    "usable_cores",
]  # fmt: skip
