"""One generated head with each angle of camera and light at a positive value: docs/images/conventions.png.

.venv/bin/python examples/conventions.py docs/images/conventions.png
"""

import sys

from PIL import Image, ImageDraw, ImageFont

from derender.data.synthetic import FaceSettings, LightSettings, ViewSettings, faces

SIDE, BAR = 192, 24
SHOWN = {
    "frontal": {}, "camera pitch +25°": {"pitch_deg": 25}, "camera yaw +25°": {"yaw_deg": 25},
    "camera roll +25°": {"roll_deg": 25}, "light pitch +50°": {"light_pitch": 50},
    "light yaw +50°": {"light_yaw": 50},
}  # fmt: skip


def head(angles: dict[str, float]) -> Image.Image:
    """The head with these angles in degrees, and 0 for all others."""

    def fixed(name: str) -> tuple[float, float]:
        return (angles.get(name, 0.0),) * 2

    view = ViewSettings(
        yaw_deg=fixed("yaw_deg"), pitch_deg=fixed("pitch_deg"), roll_deg=fixed("roll_deg"), shift=(0, 0),
        yaw_sd_deg=None, pitch_sd_deg=None, roll_sd_deg=None, shift_sd=None,
    )  # fmt: skip
    light = LightSettings(
        yaw_deg=fixed("light_yaw"), pitch_deg=fixed("light_pitch"), ambient=(0.3, 0.3), diffuse=(0.7, 0.7)
    )
    settings = FaceSettings(view=view, light=light, expressions={"neutral": 1.0}, backgrounds=("plain",))
    image = faces.generate(1, SIDE, seed=12, settings=settings).images[0]
    return Image.fromarray(image.transpose(1, 2, 0))


def main() -> None:
    canvas = Image.new("RGB", (3 * SIDE, 2 * (SIDE + BAR)), "white")
    pen, font = ImageDraw.Draw(canvas), ImageFont.load_default(14)
    for place, (label, angles) in enumerate(SHOWN.items()):
        left, top = (place % 3) * SIDE, (place // 3) * (SIDE + BAR)
        pen.text((left + 6, top + 4), label, fill="black", font=font)
        canvas.paste(head(angles), (left, top + BAR))
    canvas.save(sys.argv[1], optimize=True)


if __name__ == "__main__":
    main()
