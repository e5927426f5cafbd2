"""Embeds the same images again and again in one process, by every way of the Python API, until SIGTERM.

    python tests/trust/soaking/embedding.py FOLDER MODEL

FOLDER holds data/ and data.zip; tables go to its tables/, decoded images to its cache/. A pass that SIGTERM
stops is begun again and ended, so that no parts are left.
"""

import signal
import sys
import time
from itertools import count
from pathlib import Path

from derender.data import open_images, read_images
from derender.features import DisentangledFeatures, FeatureTable, embed_to_file
from derender.model import load
from derender.storage.atomic import atomic_file

PAUSE_SECONDS = 1.0

if __name__ == "__main__":
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    folder, net = Path(sys.argv[1]), load(sys.argv[2])
    out, features = folder / "tables" / "again.parquet", DisentangledFeatures(net)
    try:
        for passes in count(1):
            source = folder / ("data" if passes % 2 else "data.zip")
            with open_images(source) as stream:
                rows = embed_to_file(stream, net, out, fresh=True).rows
            pictures = read_images(source, net.image_size, cache=folder / "cache")
            rows += embed_to_file(pictures, net, out, fresh=True).rows
            table = FeatureTable.read(out)
            width = features.transform(pictures.images[:32]).shape[1]
            due = table.concatenate(("geometry", "albedo")).shape[1]
            if rows != 2 * len(table) or width != due:
                raise RuntimeError(f"{rows} rows, {len(table)} in the table; {width} numbers, not {due}")
            with atomic_file(folder / "passes.txt") as temporary:
                temporary.write_text(str(passes))
            time.sleep(PAUSE_SECONDS)
    except KeyboardInterrupt:
        with open_images(folder / "data") as stream:
            embed_to_file(stream, net, out, fresh=True)
