"""The steps that benchmarks/gpu.py times: derender's in three modes, and the official one done literally."""

from collections.abc import Callable
from contextlib import nullcontext
from functools import partial

import torch
from literal.step import NETS, LiteralStep
from torch import Tensor

from derender.model import Derenderer
from derender.objectives import Vgg16Features
from derender.training.config import resolve
from derender.training.step import training_step


class OurStep:
    """derender's training step at one precision, with or without LOOCC, run in one of three modes."""

    def __init__(
        self,
        device: str,
        width: int,
        batch: int,
        precision: str,
        loocc: str,
        mode: str,
        pixels: int = 64,
        chunks: int = 1,
    ):
        objective = resolve("paper", [f"loocc={loocc}"]).objective
        self.model = Derenderer.from_preset("paper", seed=0, image_size=pixels, width=width)
        self.model.to(device=device, memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]
        vgg = Vgg16Features().to(device=device, memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]
        generator = torch.Generator(device).manual_seed(0)
        self.images = torch.rand(batch, 3, pixels, pixels, device=device)
        cuda = device == "cuda"
        self.optimiser = torch.optim.Adam(
            self.model.parameters(),
            lr=1e-4,
            weight_decay=5e-4,
            fused=True,
            capturable=cuda and mode == "graph",
        )
        networks = partial(torch.autocast, device, torch.bfloat16) if precision == "bf16" else nullcontext

        def loss() -> Tensor:
            return training_step(
                self.model, self.images, objective, vgg, generator, networks, chunks=chunks
            ).total

        self.loss = torch.compile(loss) if mode == "compiled" else loss
        self.step = self.plain
        if mode == "graph":
            self.step = self.captured(generator)

    def plain(self) -> None:
        self.optimiser.zero_grad(set_to_none=True)
        self.loss().backward()
        self.optimiser.step()

    def captured(self, generator: torch.Generator) -> Callable[[], None]:
        """The whole step as one CUDA graph."""
        side = torch.cuda.Stream()
        side.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(side):
            for _ in range(3):
                self.plain()
        torch.cuda.current_stream().wait_stream(side)
        graph = torch.cuda.CUDAGraph()
        graph.register_generator_state(generator)
        self.optimiser.zero_grad(set_to_none=True)
        with torch.cuda.graph(graph):
            self.loss().backward()
            self.optimiser.step()
        return graph.replay


def literal_step(device: str, batch: int) -> Callable[[], float]:
    step, images = LiteralStep().to(device), torch.rand(batch, 3, 64, 64, device=device)
    return partial(step.step, images)


def agreement(device: str, batch: int) -> dict[str, float]:
    """Relative difference of losses and largest of the gradients: float32, same weights, without LOOCC."""
    literal = LiteralStep().to(device)
    ours = Derenderer.from_preset("paper").to(device=device, memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]
    vgg = Vgg16Features()
    with torch.no_grad():
        for name in NETS:
            pairs = zip(getattr(literal, name).parameters(), ours.nets[name].parameters(), strict=True)
            for source, target in pairs:
                target.copy_(source.view(target.shape))
        pairs = zip(literal.vgg.to_relu3_3.parameters(), vgg.features.parameters(), strict=True)
        for source, target in pairs:
            target.copy_(source)
    vgg = vgg.to(device)
    images = torch.rand(batch, 3, 64, 64, generator=torch.Generator().manual_seed(0)).to(device)
    objective = resolve("paper").objective
    generator = torch.Generator(device).manual_seed(0)
    with torch.backends.cudnn.flags(enabled=True, allow_tf32=False):
        expected = literal.loss(images)
        found = training_step(ours, images, objective, vgg, generator).total
        expected.backward()
        found.backward()
    gradients = 0.0
    for name in NETS:
        for a, b in zip(getattr(literal, name).parameters(), ours.nets[name].parameters(), strict=True):
            assert a.grad is not None and b.grad is not None
            apart = (a.grad.view(b.shape) - b.grad).norm() / a.grad.norm().clamp(min=1e-12)
            gradients = max(gradients, float(apart))
    return {"loss": abs(found.item() / expected.item() - 1), "gradient": gradients}
