"""The U-Net over skip features: shapes, each encoder's centre used once, frozen encoders."""

import copy

import pytest
import torch

from derender.evaluation.segmenters import SegmentationNet
from derender.networks import NetworkSettings
from derender.networks.encoders import UNetDecoder, UNetEncoder, pixel_decoder

WIDTH, CLASSES = 4, 5


def encoder(seed: int, size: int = 32) -> UNetEncoder:
    torch.manual_seed(seed)
    settings = NetworkSettings(image_size=size, encoder="unet", unet_width=WIDTH)
    return UNetEncoder(settings, settings.code_size)


def test_the_papers_decoder_has_the_parameters_of_its_widths():
    """Widths 16 to 256: transposed convolutions 2x2 with bias, two 3x3 with BatchNorm, a 1x1 with bias."""
    widths = [16, 32, 64, 128, 256]
    for encoders in (1, 2):
        expected, below = 16 * 19 + 19, encoders * 256
        for width in (128, 64, 32, 16):
            expected += below * width * 4 + width
            expected += (1 + encoders) * width * width * 9 + width * width * 9 + 2 * 2 * width
            below = width
        result = sum(p.numel() for p in UNetDecoder(widths, encoders, 19).parameters())
        assert result == expected


def test_the_joint_net_uses_both_centres_once():
    """Gradients reach both centres; the first step up has a channel for each of theirs, in order."""
    one, two = encoder(0), encoder(1)
    net = SegmentationNet([one, two], CLASSES).train()
    centre = one.widths[-1]
    up = net.decoder.upsample[0]
    assert up.in_channels == 2 * centre
    images, seen = torch.rand(2, 3, 32, 32), []
    handle = up.register_forward_hook(lambda module, inputs, output: seen.append(inputs[0]))
    before = net(images)
    handle.remove()
    assert torch.equal(seen[0], torch.cat([one.spatial(images), two.spatial(images)], dim=1))
    before.square().sum().backward()
    for each in (one, two):
        assert each.levels[-1][0].weight.grad.abs().sum() > 0
    for half in (slice(None, centre), slice(centre, None)):
        deaf = copy.deepcopy(net)
        with torch.no_grad():
            deaf.decoder.upsample[0].weight[half] = 0
        assert (deaf(images) - before).abs().max() > 1e-3


def still_after_a_step(net: SegmentationNet) -> tuple[set[str], set[str]]:
    """Which tensors of the encoders and of the decoder an optimiser's step leaves as they were."""
    before = [copy.deepcopy(part.state_dict()) for part in (net.encoders, net.decoder)]
    optimiser = torch.optim.Adam([p for p in net.parameters() if p.requires_grad], lr=1e-2)
    net(torch.rand(4, 3, 32, 32)).square().mean().backward()
    optimiser.step()
    encoders, decoder = (
        {name for name, value in part.state_dict().items() if torch.equal(value, old[name])}
        for part, old in zip((net.encoders, net.decoder), before, strict=True)
    )
    return encoders, decoder


def hangs_on_the_batch(encoder: UNetEncoder) -> list[bool]:
    """Of each level, whether features of an image depend on who else is in the batch."""
    images = torch.rand(4, 3, 32, 32)
    pairs = zip(encoder.skips(images[:1]), encoder.skips(images), strict=True)
    return [not torch.allclose(alone, together[:1], atol=1e-5) for alone, together in pairs]


@pytest.mark.parametrize(
    ("how", "still"),
    [({}, ("to_code",)), ({"frozen": True}, ("",)),  # every tensor
     ({"kept_statistics": True}, ("running", "num_batches", "to_code"))],
    ids=["all learn", "frozen encoders", "statistics are kept while weights learn"],
)  # fmt: skip
def test_encoders_learn_or_stay_as_asked_for_while_the_decoder_learns(how, still):
    net = SegmentationNet([encoder(0)], CLASSES, **how).train()
    assert hangs_on_the_batch(net.encoders[0]) == 4 * [not how]
    kept, decoder = still_after_a_step(net)
    assert kept == {name for name in net.encoders.state_dict() if any(word in name for word in still)}
    assert not decoder and net.encoders.training == (not how) and net.decoder.training


def test_a_decoder_that_has_learnt_is_taken_but_for_its_last_layer():
    learnt = pixel_decoder(NetworkSettings(image_size=32, encoder="unet", unet_width=WIDTH))
    before = copy.deepcopy(learnt.state_dict())
    net = SegmentationNet([encoder(0), encoder(1)], CLASSES, kept_statistics=True, decoder=learnt).train()
    taken = net.decoder.state_dict()
    ends = {"to_outputs.weight", "to_outputs.bias"}
    assert all(torch.equal(before[name], taken[name]) for name in before.keys() - ends)
    assert taken["to_outputs.weight"].shape == (CLASSES, WIDTH, 1, 1)
    assert hangs_on_the_batch(net.encoders[0]) == [False, False, True, True]
    encoders, decoder = still_after_a_step(net)
    outer = {name for name in net.encoders.state_dict() if name[2:10] in ("levels.0", "levels.1")}
    outer -= {name for name in outer if name.endswith(("weight", "bias"))}
    assert encoders == outer | {name for name in net.encoders.state_dict() if "to_code" in name}
    statistics = {name for name in taken if "running" in name or "num_batches" in name}
    assert decoder == {name for name in statistics if name.startswith(("convolve.1.", "convolve.2."))}
    assert len(net.decoder.convolve) == 3
    assert all(torch.equal(value, before[name]) for name, value in learnt.state_dict().items())
    assert not any(parameter.requires_grad for parameter in learnt.parameters())
    assert not any(part.training for part in net.eval().modules())
