"""Which values a scene may take: the bounds that networks' raw outputs are scaled to.

Source: unsup3d's published settings for faces and cats; cars differ in border depth, diffuse range and
translation. Angles are degrees here because people write settings; radians everywhere else.
"""

from pydantic import Field, model_validator

from derender.settings import Settings


class SceneRanges(Settings):
    """Bounds of every scene parameter, and the field of view that all images share."""

    fov_deg: float = Field(default=10.0, gt=0, lt=180)  # horizontal field of view
    depth_min: float = Field(default=0.9, gt=0, le=1e6)  # nearest depth; the object's centre lies at 1
    depth_max: float = Field(default=1.1, gt=0, le=1e6)  # farthest depth
    border_depth: float = Field(default=0.7 * 1.1 + 0.3 * 0.9, gt=0, le=1e6)  # held at the sides
    border_share: float = Field(default=2 / 64, ge=0, lt=0.5)  # of the width, each side, held at border_depth
    level_depth: bool = False  # remove each map's vertical slope: only the camera tilts; no published source
    lean_deg: float = Field(default=0.0, gt=-80, lt=80)  # maps start out leaning back, for views from above
    ambient: tuple[float, float] = (0.0, 1.0)  # range of ambient light
    diffuse: tuple[float, float] = (0.0, 1.0)  # range of directional light
    light_deg: float = Field(default=45.0, gt=0, lt=90)  # light pitch and yaw lie in +- this
    rotation_deg: float = Field(default=60.0, gt=0, lt=90)  # camera angles lie in +- this
    translation_xy: float = Field(default=0.1, ge=0, le=1e6)  # camera shifts lie in +- this, scene units
    translation_z: float = Field(default=0.0, ge=0, le=1e6)  # the same along z

    @model_validator(mode="after")
    def _ordered(self) -> "SceneRanges":
        if self.depth_min >= self.depth_max:
            raise ValueError(f"depth_min {self.depth_min} must be below depth_max {self.depth_max}")
        for name in ("ambient", "diffuse"):
            low, high = getattr(self, name)
            if low > high:
                raise ValueError(f"{name} must be (low, high) with low <= high, got ({low}, {high})")
        return self

    def border_columns(self, width: int) -> int:
        """How many pixel columns at each side are held at ``border_depth`` (2 at 64 pixels)."""
        return round(self.border_share * width)
