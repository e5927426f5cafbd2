"""Tables of the demo's protocols: clusters, depth, factors and reconstructions, each beside its controls."""

from derender.evaluation import (
    FactorResult,
    GeometryResult,
    GeometryScores,
    ReconstructionResult,
)
from derender.evaluation.score_table import Column, Row, ScoreTable


def geometry_table(result: GeometryResult, pictures: int) -> ScoreTable:
    """Depth and normal errors beside average depth, a plane and, where it was scored, an untrained model."""
    columns = (
        Column("SIDE x 100", "low", note="scale-invariant depth error times 100, best 0"),
        Column("MAD", "low", 1, "mean angle between normals in degrees, best 0"),
        Column(
            "coverage",
            None,
            note="share of the true object that the prediction covers; errors count only there",
        ),
    )

    def row(name: str, scores: GeometryScores, control: bool, note: str = "") -> Row:
        return Row(name, (100 * scores.side, scores.mad_deg, scores.coverage), control, note)

    rows = [
        row("model", result.model, False),
        row(
            "average depth", result.average_depth, True, "the mean true depth map, the same for every picture"
        ),
        row("plane", result.plane, True),
    ]
    if result.untrained is not None:
        rows.append(row("untrained model", result.untrained, True, "same networks, fresh weights"))
    return ScoreTable(f"Geometry on {pictures:,} pictures with exact depth", "prediction", columns, rows)


def factor_table(result: FactorResult, pictures: int, untrained: FactorResult | None = None) -> ScoreTable:
    """Errors of albedo, light and camera beside the best constant answers and an untrained model's."""
    columns = (
        Column("albedo", "low", 4, "root mean square error after each picture's best scale, best 0"),
        Column("one scale", "low", 4, "the same after one scale for all pictures"),
        Column("light", "low", 1, "mean angle in degrees between true and found direction, best 0"),
        Column("aligned", "low", 1, "the same after the best rotation of all directions at once"),
        Column("camera", "low", 1, "mean angle in degrees of the rotation left over, best 0"),
    )

    def row(name: str, scores: FactorResult, control: bool = False) -> Row:
        errors = (scores.albedo, scores.albedo_global)
        angles = (scores.light, scores.light_aligned, scores.camera)
        return Row(name, (*errors, *(angle.mean_deg for angle in angles)), control)

    light = result.light_control.mean_deg
    constant = (result.albedo_control, result.albedo_global_control, light, light)
    note = "mean albedo, mean light, a camera that never turns"
    rows = [
        row("model", result),
        Row("constant answer", (*constant, result.camera_control.mean_deg), True, note),
    ]
    if untrained is not None:
        rows.append(row("untrained model", untrained, control=True))
    return ScoreTable(f"Albedo, light and camera on {pictures:,} pictures", "prediction", columns, rows)


def reconstruction_table(result: ReconstructionResult, pictures: int, components: str = "PCA") -> ScoreTable:
    """How well pictures are rendered again, beside the controls that were scored.

    ``components`` is what the row of principal components is called.
    """
    columns = (
        Column("L1", "low", 4, "mean absolute difference inside the mask, 0 to 1, best 0"),
        Column("PSNR", "high", 2, "peak signal-to-noise ratio in decibels"),
        Column("SSIM", "high", note="structural similarity of windows inside the mask, at most 1"),
        Column("coverage", None, note="share of all pixels inside the mask"),
    )
    scored = {"model": result.model, "mean picture": result.mean_picture}
    if result.components is not None:
        scored[components] = result.components
    if result.untrained is not None:
        scored["untrained model"] = result.untrained
    notes = {"untrained model": "same networks, fresh weights, inside its own mask"}
    rows = [
        Row(name, (s.l1, s.psnr_db, s.ssim, s.coverage), name != "model", notes.get(name, ""))
        for name, s in scored.items()
    ]
    return ScoreTable(f"Reconstruction of {pictures:,} pictures", "prediction", columns, rows)
