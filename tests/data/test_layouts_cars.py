"""Rendered ShapeNet cars: parts by folder, the published crop, classes by words of ShapeNet's table."""

import numpy as np
import pytest
from tests.data.conftest import noise

from derender.data import list_images, read_pictures
from derender.data.image import decode
from derender.data.layouts.cars import CAR_CLASSES, car_class

IDS = [f"{row:031x}a" for row in range(6)] + ["1c9725db9005eda1aaa354fd606bff0"]
TABLE = (
    "fullId,wnsynset,wnlemmas,up,front,name,tags\n"
    f'3dw.{IDS[0]},n1,"cruiser,police cruiser,patrol car,police car",,,Crown Victoria,\n'
    f'3dw.{IDS[1]},n2,"ambulance",,,"Krankenwagen, weiss","ambulance,red cross"\n'
    f'3dw.{IDS[2]},n3,"car,auto",,,Lincoln Town Car LIMO,"long"\n'
    f'3dw.{IDS[3]},n4,"jeep,landrover",,,Wrangler,\n'
    f'3dw.{IDS[4]},n5,"sports car,sport car",,,Ferrari 458,italy\n'
    f'3dw.{IDS[6]},n6,"car,auto",,,Jeepney of Manila,"bus"\n'
)
PARTS = ("train", "train", "train", "val", "val", "test", "test")


def tree_of(files):
    return {
        f"{part}/{name}_{row}.png": files(row)
        for row, (part, name) in enumerate(zip(PARTS, IDS, strict=True))
    }


def inventory_of(source, **options):
    inventory = list_images(source, **options)
    inventory.files.close()
    return inventory


@pytest.mark.parametrize("zipped", [False, True])
@pytest.mark.parametrize("name", ["02958343.csv", "metadata.csv"])
def test_classes_by_the_table(tree, zipped, name):
    source = tree({**tree_of(lambda row: None), name: TABLE}, zipped)
    inventory = inventory_of(source)
    assert inventory.layout == "shapenet_cars"
    found = inventory.table
    by_model = dict(zip(found.labels["model"], found.labels["class"], strict=True))
    assert [by_model[model] for model in IDS] == [*CAR_CLASSES, "", ""]
    assert found.labels["name"][found.labels["model"] == IDS[4]].tolist() == ["Ferrari 458"]
    assert sorted(found.partition.tolist()) == sorted({"val": "validation"}.get(part, part) for part in PARTS)
    assert inventory_of(f"{source}::val").table.files == tuple(sorted(f for f in found.files if "val/" in f))


@pytest.mark.parametrize(
    ("texts", "kind"),
    [
        (("Police Jeep", "", "jeep"), "police"),
        (("stretch_limo", "", ""), "limousine"),
        (("Limonade van", "policeman's", "car"), ""),
        (("", "sports cars", ""), "sports"),
        (("transport car", "", "car"), ""),
        (("", "", ""), ""),
    ],
)
def test_class_by_whole_words(texts, kind):
    assert car_class(*texts) == kind


def test_the_published_crop(tree, encoded):
    contents = {row: encoded(noise(row, 128, 128)) for row in range(7)}
    source = tree({**tree_of(contents.get), "metadata.csv": TABLE})
    pictures = read_pictures(source, 25)
    for row, file in enumerate(pictures.files):
        whole = contents[int(file[:-4].rsplit("_", 1)[1])]
        assert (
            pictures.images[row] == decode(whole, 25, "crop", np.array([14, 8, 114, 108], np.float32))
        ).all()
    other = inventory_of(
        tree({**tree_of(lambda row: encoded(noise(row, 64, 64))), "metadata.csv": TABLE}, name="other")
    )
    assert other.table.boxes is None


def test_hexadecimal_names_alone_are_not_cars(tree):
    """Scraped pictures are often named by a checksum."""
    files = [f"{name}.png" for name in IDS]
    assert inventory_of(tree(files)).layout == "folder"
    asked = inventory_of(tree(files), dataset="shapenet_cars").table
    assert asked.labels["model"].tolist() == IDS
    assert asked.partition is None


def test_parts_without_ids_when_asked_for(tree):
    files = ["train/images/0.png", "test/images/1.png", "test/depth/1.png"]
    found = inventory_of(tree(files), dataset="shapenet_cars").table
    assert found.files == ("test/images/1.png", "train/images/0.png")
    assert (found.labels, sorted(found.partition)) == ({}, ["test", "train"])


def test_faults_are_named(tree):
    with pytest.raises(
        ValueError, match=r"holds no rendered ShapeNet cars: expected folders train, val and test"
    ):
        list_images(tree(["1.png"]), dataset="shapenet_cars")
    strangers = TABLE.splitlines()[0] + "\n3dw.ffff,n,,,,x,y\n"
    with pytest.raises(
        ValueError, match=r"metadata\.csv in .* names none of the models there; ShapeNet's owners"
    ):
        list_images(tree({**tree_of(lambda row: None), "metadata.csv": strangers}, name="strangers"))
    short = "fullId,name\n3dw.ffff,x\n"
    with pytest.raises(ValueError, match="has no column 'wnlemmas'; its columns are fullId, name"):
        list_images(tree({**tree_of(lambda row: None), "metadata.csv": short}, name="short"))
