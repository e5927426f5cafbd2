"""The U-Net over skip features: shapes, each encoder's centre used once, frozen encoders."""

import copy

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


def test_frozen_encoders_keep_weights_and_statistics_while_the_decoder_learns():
    net = SegmentationNet([encoder(0)], CLASSES, frozen=True).train()
    free = SegmentationNet([encoder(0)], CLASSES).train()
    for each, stays in ((net, True), (free, False)):
        before = {name: value.clone() for name, value in each.encoders.state_dict().items()}
        decoder = {name: value.clone() for name, value in each.decoder.state_dict().items()}
        optimiser = torch.optim.Adam([p for p in each.parameters() if p.requires_grad], lr=1e-2)
        each(torch.rand(4, 3, 32, 32)).square().mean().backward()
        optimiser.step()
        after = each.encoders.state_dict()
        code = {name for name in before if ".to_code." in name}
        assert all(torch.equal(before[name], after[name]) for name in (before if stays else code))
        changed = [name for name in before if not torch.equal(before[name], after[name])]
        assert stays or len(changed) == len(before) - len(code)
        assert any(not torch.equal(value, each.decoder.state_dict()[name]) for name, value in decoder.items())


def test_statistics_are_kept_while_weights_learn_where_asked_for():
    net = SegmentationNet([encoder(0)], CLASSES, kept_statistics=True).train()
    before = {name: value.clone() for name, value in net.encoders.state_dict().items()}
    optimiser = torch.optim.Adam([p for p in net.parameters() if p.requires_grad], lr=1e-2)
    images = torch.rand(4, 3, 32, 32)
    alone, together = net.encoders[0].spatial(images[:1]), net.encoders[0].spatial(images)[:1]
    assert torch.allclose(alone, together, atol=1e-5)  # nobody's features hang on who else is in the batch
    net(images).square().mean().backward()
    optimiser.step()
    after = net.encoders.state_dict()
    same = {name for name in before if torch.equal(before[name], after[name])}
    kept = ("running", "num_batches", "to_code")
    assert same == {name for name in before if any(word in name for word in kept)}
    assert not net.encoders.training and net.decoder.training


def test_a_decoder_that_has_learnt_is_taken_but_for_its_last_layer():
    learnt = pixel_decoder(NetworkSettings(image_size=32, encoder="unet", unet_width=WIDTH))
    before = {name: value.clone() for name, value in learnt.state_dict().items()}
    pair = [encoder(0), encoder(1)]
    net = SegmentationNet(pair, CLASSES, kept_statistics=True, decoder=learnt).train()
    taken = {name: value.clone() for name, value in net.decoder.state_dict().items()}
    ends = {"to_outputs.weight", "to_outputs.bias"}
    assert all(torch.equal(before[name], taken[name]) for name in before.keys() - ends)
    assert taken["to_outputs.weight"].shape == (CLASSES, WIDTH, 1, 1)
    encoders = {name: value.clone() for name, value in net.encoders.state_dict().items()}
    optimiser = torch.optim.Adam([p for p in net.parameters() if p.requires_grad], lr=1e-2)
    images = torch.rand(4, 3, 32, 32)
    alone, together = net.encoders[0].skips(images[:1]), net.encoders[0].skips(images)
    hangs = [not torch.allclose(one, all_[:1], atol=1e-5) for one, all_ in zip(alone, together, strict=True)]
    assert hangs == [False, False, True, True]  # on who else is in the batch
    net(images).square().mean().backward()
    optimiser.step()
    same = {name for name, value in net.encoders.state_dict().items() if torch.equal(value, encoders[name])}
    outer = {name for name in encoders if name[2:10] in ("levels.0", "levels.1")}
    outer -= {name for name in outer if name.endswith(("weight", "bias"))}
    assert same == outer | {name for name in encoders if "to_code" in name}
    after = net.decoder.state_dict()
    still = {name for name in taken if torch.equal(taken[name], after[name])}
    statistics = {name for name in taken if "running" in name or "num_batches" in name}
    assert still == {name for name in statistics if name.startswith(("convolve.1.", "convolve.2."))}
    assert len(net.decoder.convolve) == 3
    assert all(torch.equal(value, before[name]) for name, value in learnt.state_dict().items())
    assert not any(parameter.requires_grad for parameter in learnt.parameters())
    assert not any(part.training for part in net.eval().modules())
