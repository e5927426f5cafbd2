"""Networks of others: every key and shape by name, the numbers that come back, and files that are refused.

No published StyleGAN2 or e4e is at hand; the lists below are written out from the architecture (the layout of
stylegan2-pytorch and encoder4editing), by another way than the library's, and files are made from them.
"""

import json
import os
import pickle
from argparse import Namespace

import pytest
import torch
from torch.nn.functional import interpolate
from transformers import Dinov2Config, Dinov2Model, ViTConfig, ViTModel

from derender.baselines.e4e import E4e, E4eSettings
from derender.baselines.generator import FILTER, Generator, GeneratorSettings
from derender.baselines.published import (
    GENERATOR_NAMES,
    IMAGENET_MEAN,
    IMAGENET_STD,
    Dinov2,
    encoder_names,
    load_published_e4e,
    load_published_generator,
    published_names,
)
from derender.storage.tensors import reads_safely

reads_pickles = pytest.mark.skipif(not reads_safely(), reason="this PyTorch is not trusted with pickles")

CONFIG_F = {4: 512, 8: 512, 16: 512, 32: 512, 64: 512, 128: 256, 256: 128, 512: 64, 1024: 32}
LITTLE = {4: 6, 8: 6, 16: 6, 32: 3}


def published_generator(widths, style=512, mapping=8):
    """Names and shapes of ``g_ema`` in a file of stylegan2-pytorch, from the widths at each resolution."""
    found = {"input.input": (1, widths[4], 4, 4), "noises.noise_0": (1, 1, 4, 4)}

    def modulated(name, weight, inputs):
        found[f"{name}.conv.weight"] = (1, *weight)
        found[f"{name}.conv.modulation.weight"] = (inputs, style)
        found[f"{name}.conv.modulation.bias"] = (inputs,)

    def styled(name, inputs, outputs):
        modulated(name, (outputs, inputs, 3, 3), inputs)
        found[f"{name}.noise.weight"], found[f"{name}.activate.bias"] = (1,), (outputs,)

    def colours(name, inputs):
        modulated(name, (3, inputs, 1, 1), inputs)
        found[f"{name}.bias"] = (1, 3, 1, 1)

    for layer in range(1, mapping + 1):
        found[f"style.{layer}.weight"], found[f"style.{layer}.bias"] = (style, style), (style,)
    styled("conv1", widths[4], widths[4])
    colours("to_rgb1", widths[4])
    for step, size in enumerate(sorted(widths)[1:]):
        styled(f"convs.{2 * step}", widths[size // 2], widths[size])
        styled(f"convs.{2 * step + 1}", widths[size], widths[size])
        colours(f"to_rgbs.{step}", widths[size])
        found[f"convs.{2 * step}.conv.blur.kernel"] = found[f"to_rgbs.{step}.upsample.kernel"] = (4, 4)
        for half in (1, 2):
            found[f"noises.noise_{2 * step + half}"] = (1, 1, size, size)
    return found


def published_encoder(stages, heads, width=64, style=512, reduction=16):
    """Names and shapes of ``encoder.*`` there, without the prefix; heads: (how many, their convolutions)."""
    found = {"input_layer.0.weight": (width, 3, 3, 3), "input_layer.2.weight": (width,)}

    def norm(name, channels):
        for part in ("weight", "bias", "running_mean", "running_var"):
            found[f"{name}.{part}"] = (channels,)
        found[f"{name}.num_batches_tracked"] = ()

    norm("input_layer.1", width)
    afters, before = [width * 2**stage for stage, units in enumerate(stages) for _ in range(units)], width
    for number, after in enumerate(afters):
        name = f"body.{number}"
        if before != after:
            found[f"{name}.shortcut_layer.0.weight"] = (after, before, 1, 1)
            norm(f"{name}.shortcut_layer.1", after)
        norm(f"{name}.res_layer.0", before)
        found[f"{name}.res_layer.1.weight"] = (after, before, 3, 3)
        found[f"{name}.res_layer.2.weight"] = (after,)
        found[f"{name}.res_layer.3.weight"] = (after, after, 3, 3)
        norm(f"{name}.res_layer.4", after)
        found[f"{name}.res_layer.5.fc1.weight"] = (after // reduction, after, 1, 1)
        found[f"{name}.res_layer.5.fc2.weight"] = (after, after // reduction, 1, 1)
        before = after
    for code, convolutions in enumerate(number for count, number in heads for _ in range(count)):
        for index in range(convolutions):
            inputs = style if index else before
            found[f"styles.{code}.convs.{2 * index}.weight"] = (style, inputs, 3, 3)
            found[f"styles.{code}.convs.{2 * index}.bias"] = (style,)
        found[f"styles.{code}.linear.weight"], found[f"styles.{code}.linear.bias"] = (style, style), (style,)
    for layer, part in ((1, 2), (2, 4)):
        found[f"latlayer{layer}.weight"] = (before, before // part, 1, 1)
        found[f"latlayer{layer}.bias"] = (before,)
    return found


def filled(shapes, generator):
    """Tensors of these shapes: filters as they are, everything else random."""
    taps = 2 * torch.tensor(FILTER)
    found = {}
    for name, shape in shapes.items():
        if name.endswith("num_batches_tracked"):
            found[name] = torch.tensor(7)
        elif name.endswith(".kernel"):
            found[name] = torch.outer(taps, taps)
        else:
            found[name] = torch.rand(shape, generator=generator) + 0.1
    return found


@pytest.fixture
def generator_weights(generator):
    return filled(published_generator(LITTLE, style=8, mapping=2), generator)


@pytest.fixture
def e4e_content(generator):
    """A small encoder for 64 pixels, of a generator of 32 pixels (8 codes)."""
    encoder = published_encoder((2, 1, 3, 1), ((3, 2), (4, 3), (1, 4)), width=4, style=8, reduction=2)
    decoder = published_generator(LITTLE, style=8, mapping=2)
    state = {f"encoder.{name}": value for name, value in filled(encoder, generator).items()}
    state |= {f"decoder.{name}": value for name, value in filled(decoder, generator).items()}
    return {
        "state_dict": state,
        "latent_avg": torch.rand(8, 8, generator=generator),
        "opts": Namespace(dataset_type="ffhq_encode", learning_rate=1e-4),
    }


def save(content, path):
    torch.save(content, path)
    return path


def config_f(size):
    """The published networks' sizes."""
    return GeneratorSettings(image_size=size, style_size=512, channel_base=32_768, channel_max=512)


def layout(module, names):
    """Published names of a module's tensors with their shapes but for dimensions of 1; none twice."""
    state = module.state_dict()
    published = published_names(state, names)
    assert len(set(published.values())) == len(state)
    return without_ones({there: state[here].shape for here, there in published.items()})


def without_ones(shapes):
    return {name: [size for size in shape if size != 1] for name, shape in shapes.items()}


@pytest.mark.parametrize(("size", "count"), [(1024, 171), (256, 135)])
def test_the_generators_layout_is_the_published_one(size, count):
    widths = {side: width for side, width in CONFIG_F.items() if side <= size}
    wanted = published_generator(widths)
    with torch.device("meta"):
        net = Generator(config_f(size))
    made = layout(net, GENERATOR_NAMES)
    made |= without_ones({name: shape for name, shape in wanted.items() if name.endswith(".kernel")})
    assert made == without_ones(wanted) and len(made) == count


@pytest.mark.parametrize(
    ("size", "heads"), [(1024, ((3, 4), (4, 5), (11, 6))), (256, ((3, 4), (4, 5), (7, 6)))]
)
def test_the_encoders_layout_is_the_published_one(size, heads):
    units = (3, 4, 14, 3)
    settings = E4eSettings(image_size=256, width=64, units=units, reduction=16, generator=config_f(size))
    with torch.device("meta"):
        model = E4e(settings)
    wanted = published_encoder(units, heads)
    assert layout(model.encoder, encoder_names(units)) == without_ones(wanted)
    if size == 1024:
        assert sum(value.numel() for value in model.encoder.parameters()) == 267_136_704
        assert tuple(model.centre.shape) == (18, 512)


@reads_pickles
def test_a_generator_file_becomes_ours(generator_weights, tmp_path):
    path = save({"g_ema": generator_weights, "latent_avg": torch.zeros(8)}, tmp_path / "generator.pt")
    net = load_published_generator(path)
    assert net.settings == GeneratorSettings(
        image_size=32, style_size=8, mapping_layers=2, channel_base=96, channel_max=6
    )
    assert torch.equal(net.convs[3].weight, generator_weights["convs.2.conv.weight"][0])
    assert torch.equal(net.to_rgbs[0].bias, generator_weights["to_rgb1.bias"].flatten())
    assert torch.equal(net.mapping.layers[1].bias, generator_weights["style.2.bias"])
    assert torch.equal(net.fixed_noise()[6], generator_weights["noises.noise_6"])
    assert net(torch.ones(1, 8), net.fixed_noise()).isfinite().all()
    kept = {name: value for name, value in generator_weights.items() if not name.startswith("noises")}
    early = save({"g_ema": kept}, tmp_path / "early.pt")  # such files have no noise maps
    first, second = (load_published_generator(early).fixed_noise() for _ in range(2))
    assert all(torch.equal(a, b) for a, b in zip(first, second, strict=True))


@reads_pickles
@pytest.mark.parametrize("zipped", [True, False], ids=["zip", "legacy"])
def test_an_e4e_file_becomes_ours(e4e_content, tmp_path, zipped):
    path = tmp_path / "e4e.pt"
    torch.save(e4e_content, path, _use_new_zipfile_serialization=zipped)
    model, state = load_published_e4e(path), e4e_content["state_dict"]
    assert model.settings.units == (2, 1, 3, 1) and model.settings.width == 4
    assert (model.image_size, model.settings.reduction, model.settings.generator.image_size) == (64, 2, 32)
    assert torch.equal(model.centre, e4e_content["latent_avg"])
    excite = model.encoder.stages[2][1].excite.weight
    assert torch.equal(excite, state["encoder.body.4.res_layer.5.fc2.weight"])
    assert torch.equal(model.generator.constant, state["decoder.input.input"])
    found = model.embed(torch.rand(2, 3, 64, 64))["w+"]
    assert found.shape == (2, 64) and not model.training
    one_for_all = e4e_content | {"latent_avg": e4e_content["latent_avg"][0]}
    model = load_published_e4e(save(one_for_all, path))
    assert torch.equal(model.centre, one_for_all["latent_avg"].expand(8, -1))


@reads_pickles
@pytest.mark.parametrize(
    ("key", "value", "told"),
    [
        ("convs.1.activate.bias", None, "it has no 'convs.1.activate.bias'"),
        ("convs.1.activate.bias", torch.zeros(4), r"s.1.activate.bias' has shape \(4,\), expected \(6,\)"),
        ("convs.0.conv.blur.kernel", torch.ones(4, 4), "'convs.0.conv.blur.kernel' is not the filter"),
        ("extra", torch.zeros(1), "it has 'extra', which ours lacks"),
        ("input.input", None, "has no 'input.input'"),
        ("style.1.weight", torch.zeros(3), "'style.1.weight' has shape"),
        ("input.input", torch.zeros(3), "is of another architecture: "),
    ],
)
def test_another_architecture_is_named_by_its_first_key(generator_weights, tmp_path, key, value, told):
    generator_weights |= {key: value}
    kept = {name: tensor for name, tensor in generator_weights.items() if tensor is not None}
    with pytest.raises(ValueError, match=told):
        load_published_generator(save({"g_ema": kept}, tmp_path / "generator.pt"))


class Attack:
    """What a hostile pickle asks for; tests/trust/test_no_code.py has one for every reader."""

    def __init__(self, command):
        self.command = command

    def __reduce__(self):
        return os.system, (self.command,)


@reads_pickles
def test_damaged_and_missing_files_are_one_clear_error(e4e_content, tmp_path):
    path = save(e4e_content, tmp_path / "e4e.pt")
    whole = path.read_bytes()
    for damage in (whole[: len(whole) // 2], b"", b"not a pickle at all", b"\x80\x02}q\x00."):
        path.write_bytes(damage)
        with pytest.raises(ValueError, match=r"e4e\.pt (is damaged|has no 'state_dict')") as told:
            load_published_e4e(path)
        assert "\n" not in str(told.value)
    with pytest.raises(FileNotFoundError, match=r"nothing is downloaded here; get e4e_ffhq_encode\.pt"):
        load_published_e4e(tmp_path / "nowhere.pt")
    with pytest.raises(ValueError, match="no weights by name"):
        load_published_generator(save({"g_ema": [1, 2]}, path))


TINY = {"hidden_size": 8, "num_hidden_layers": 2, "num_attention_heads": 2}
TINY |= {"image_size": 28, "patch_size": 14}


@pytest.fixture(scope="module")
def dinov2(tmp_path_factory, seeded):
    """A tiny DINOv2 with random weights in a folder, and the network itself."""
    folder, net = tmp_path_factory.mktemp("dinov2"), seeded(Dinov2Model, Dinov2Config(**TINY)).eval()
    net.save_pretrained(folder)
    return folder, net


def test_features_of_dinov2_are_the_class_token_and_the_mean_patch(dinov2):
    folder, net = dinov2
    model = Dinov2.open(str(folder), image_size=32, enlarged=28)
    model.choose(("class", "patches"))
    images = torch.rand(3, 3, 32, 32)
    features = model.embed(images)
    large = interpolate(images, (28, 28), mode="bicubic", antialias=True).clamp(0, 1)
    mean, std = (torch.tensor(values).view(3, 1, 1) for values in (IMAGENET_MEAN, IMAGENET_STD))
    with torch.no_grad():
        tokens = net(pixel_values=(large - mean) / std).last_hidden_state
    torch.testing.assert_close(features["class"], tokens[:, 0])
    torch.testing.assert_close(features["patches"], tokens[:, 1:].mean(dim=1))
    assert not model.training and not any(value.requires_grad for value in model.parameters())


def test_other_weights_than_a_dinov2_in_one_safetensors_file_are_refused(dinov2, tmp_path):
    _, net = dinov2
    pickled, other, deeper, parts = (tmp_path / name for name in ("pickled", "other", "deeper", "parts"))
    net.config.save_pretrained(pickled)
    (pickled / "pytorch_model.bin").write_bytes(pickle.dumps(Attack(f"touch {tmp_path / 'it-ran'}")))
    ViTModel(ViTConfig(**TINY, intermediate_size=8)).save_pretrained(other)
    net.save_pretrained(deeper)
    Dinov2Config(**{**TINY, "num_hidden_layers": 3}).save_pretrained(deeper)
    net.config.save_pretrained(parts)  # an index of shards, which could name files outside the folder
    names = dict.fromkeys(net.state_dict(), "../deeper/model.safetensors")
    (parts / "model.safetensors.index.json").write_text(json.dumps({"metadata": {}, "weight_map": names}))
    for source, told in (
        (tmp_path / "x.pth", r"x\.pth has no model\.safetensors: .*pickles, which can run code"),
        (pickled, "pickles, which can run code, are not opened"),
        (other, "is a vit, expected a dinov2"),
        (deeper, r"of another architecture: it has no 'encoder\.layer\.2"),
        (parts, r"parts has no model\.safetensors: .*Weights in parts"),
        (
            "someone/none",
            "weights someone/none are not in the Hugging Face cache.*'hf download someone/none'",
        ),
    ):
        with pytest.raises(ValueError, match=told):
            Dinov2.open(str(source))
    assert not (tmp_path / "it-ran").exists()
