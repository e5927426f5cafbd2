"""Collections too large to keep: pictures that come one after another, in order, with their labels.

sample    what a stream hands on: a name, a way to its bytes, labels
address   from what the user wrote to a stream: shards, a Hugging Face id, or neither
shards    WebDataset: tar files; huggingface: the `datasets` library; listed: folders and zips, as a stream
decoding  samples to pixels on every core, a bounded number ahead
seen      which pixels came before, in 24 bytes a picture; labels: columns whose kind shows only at the end
collect   a whole stream into the memory-mapped file, for training

Nothing is written to disk but decoded pixels, so names in archives can do no harm.
"""

from derender.data.stream.address import open_stream
from derender.data.stream.decoding import Decoded, ahead, decode_samples, decoded
from derender.data.stream.labels import Kinds, column_of
from derender.data.stream.listed import ListedStream, stream_of
from derender.data.stream.sample import Sample, Stream
from derender.data.stream.seen import SeenPixels

__all__ = [
    "Decoded",
    "Kinds",
    "ListedStream",
    "Sample",
    "SeenPixels",
    "Stream",
    "ahead",
    "column_of",
    "decode_samples",
    "decoded",
    "open_stream",
    "stream_of",
]
