"""The VQ-VAE has the paper's parameters, quantises to the nearest entry, and keeps its codebook in use."""

from contextlib import nullcontext

import pytest
import torch

from derender.baselines.model import LossInputs
from derender.baselines.vqvae import Vqvae, VqvaeConfig, VqvaeSettings, codes_used

TINY = VqvaeSettings(image_size=32, width=8, codes=16)


def made(settings: VqvaeSettings = TINY, seed: int = 0) -> Vqvae:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return Vqvae(settings)


def pictures(count: int = 6, seed: int = 0) -> torch.Tensor:
    return torch.rand(count, 3, 32, 32, generator=torch.Generator().manual_seed(seed))


def losses(model: Vqvae, images: torch.Tensor, seed: int = 0) -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    return model.losses(images, LossInputs(VqvaeConfig(), generator, nullcontext))


@pytest.mark.parametrize(("width", "count"), [(512, 19_199_491), (416, 12_724_195)])
def test_both_readings_have_their_number_of_parameters(width, count):
    with torch.device("meta"):
        model = Vqvae(VqvaeSettings(width=width))
    assert sum(value.numel() for value in model.parameters() if value.requires_grad) == count
    codebook = [value for name, value in model.named_parameters() if name.startswith("codebook")]
    assert [tuple(value.shape) for value in codebook] == [(1, 512, width)]


def test_every_place_gets_the_nearest_entry_and_gradients_go_their_two_ways():
    model = made()
    losses(model, pictures())  # k-means starts the codebook
    model.eval()
    grid = torch.randn(2, 8, 5, 5, requires_grad=True)
    found = model.quantise(grid)
    entries = model.codebook.codebook
    distance = torch.cdist(grid.detach().permute(0, 2, 3, 1).reshape(-1, 8), entries.detach())
    assert torch.equal(found.indices.flatten(), distance.argmin(dim=1))
    torch.testing.assert_close(found.through, found.entries)
    torch.testing.assert_close(found.entries[1, :, 2, 3], entries[found.indices[1, 2, 3]])

    model.train()
    found = model.quantise(grid)
    cotangent = torch.randn(2, 8, 5, 5)
    to_grid, to_codebook = torch.autograd.grad(
        (found.through * cotangent).sum(), [grid, entries], allow_unused=True, retain_graph=True
    )
    torch.testing.assert_close(to_grid, cotangent)
    assert to_codebook is None or not to_codebook.any()
    (through_entries,) = torch.autograd.grad(
        (found.entries * cotangent).sum(), [model.codebook._codebook.embed]
    )
    expected = torch.zeros(16, 8).index_add_(
        0, found.indices.flatten(), cotangent.permute(0, 2, 3, 1).reshape(-1, 8)
    )
    torch.testing.assert_close(through_entries[0], expected)


def test_the_three_losses_are_those_of_the_source():
    model = made().train()
    losses(model, pictures())
    before = {name: value.clone() for name, value in model.state_dict().items()}
    terms = losses(model, pictures())
    model.load_state_dict(before)
    grid = model.encode(pictures())
    found = model.quantise(grid)
    gap = (found.entries - grid).square().mean()
    torch.testing.assert_close(terms["codebook"], gap)
    torch.testing.assert_close(terms["commitment"], 0.25 * gap)
    again = model.decode(found.through)
    torch.testing.assert_close(terms["reconstruction"], 4 * (again - pictures()).square().mean())


def test_training_lowers_the_error_and_keeps_the_codebook_in_use(blobs):
    model = made().train()
    images = torch.from_numpy(blobs.images[:16]).float() / 255
    optimiser = torch.optim.Adam(model.parameters(), 3e-3)
    generator, history = torch.Generator().manual_seed(0), []
    for _ in range(40):
        terms = model.losses(images, LossInputs(VqvaeConfig(), generator, nullcontext))
        optimiser.zero_grad()
        (terms["reconstruction"] + terms["codebook"] + terms["commitment"]).backward()
        optimiser.step()
        history.append({name: value.item() for name, value in terms.items()})
    assert history[-1]["reconstruction"] < 0.4 * history[0]["reconstruction"]
    assert history[-1]["codes_used"] > 6


def test_an_entry_that_nobody_chooses_is_given_to_a_place_of_the_batch():
    model = made().train()
    losses(model, pictures())
    with torch.no_grad():
        model.codebook._codebook.embed[0, 3] = 1e4
        model.codebook._codebook.cluster_size[0, 3] = 0.0
    losses(model, pictures())
    assert model.codebook._codebook.embed[0, 3].abs().max() < 100
    still = made(TINY.model_copy(update={"dead_below": 0.0})).train()
    losses(still, pictures())
    with torch.no_grad():
        still.codebook._codebook.embed[0, 3] = 1e4
    losses(still, pictures())
    assert still.codebook._codebook.embed[0, 3].min() == 1e4


def test_the_library_draws_from_our_generator_alone():
    state = torch.random.get_rng_state()
    first, again, other = made(), made(), made()
    for model, seed in ((first, 1), (again, 1), (other, 2)):
        losses(model, pictures(), seed)
    assert torch.equal(torch.random.get_rng_state(), state)
    assert torch.equal(first.codebook.codebook, again.codebook.codebook)
    assert not torch.equal(first.codebook.codebook, other.codebook.codebook)


def test_codes_used_is_one_for_one_and_all_for_all():
    assert codes_used(torch.zeros(2, 3, 3, dtype=torch.long), 8) == 1
    assert codes_used(torch.arange(8).reshape(1, 2, 4), 8) == pytest.approx(8)
    assert codes_used(torch.tensor([[[0, 0, 1, 1]]]), 8) == pytest.approx(2)


def test_features_are_the_map_its_mean_and_its_histogram():
    model = made()
    losses(model, pictures())
    model.eval()
    assert list(model.embed(pictures())) == ["pooled"]
    model.choose(("histogram", "map", "pooled"))
    features = model.embed(pictures())
    assert {name: tuple(value.shape) for name, value in features.items()} == {
        "histogram": (6, 16),
        "map": (6, 8 * 8 * 8),
        "pooled": (6, 8),
    }
    codebook = model.codebook.codebook
    torch.testing.assert_close(features["pooled"], features["map"].view(6, 8, 64).mean(dim=2))
    torch.testing.assert_close(features["pooled"], features["histogram"] @ codebook)
    with pytest.raises(ValueError, match="vqvae has no feature 'poold'; did you mean 'pooled'"):
        model.choose(("poold",))
    with pytest.raises(ValueError, match=r"takes images of shape \(N, 3, 32, 32\), got \(1, 3, 16, 16\)"):
        model.embed(torch.rand(1, 3, 16, 16))
