"""Which model of lens and shutter a block is solved with: the one that predicts tie points left out best."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from geomosaic.adjustment.model import Block, ImageResiduals, ModelChoice, Settings
from geomosaic.adjustment.problem.interior import INTERIOR, READOUT
from geomosaic.adjustment.problem.tracks import Tracks
from geomosaic.adjustment.procedure.block_problem import NOMINAL_READOUT_S
from geomosaic.adjustment.procedure.cross_validation import BETTER, Judged, LeftOut, Model
from geomosaic.adjustment.procedure.residual_pattern import left_by_vibration, residual_patterns
from geomosaic.adjustment.solver.solution import Solution, Start
from geomosaic.adjustment.terms.gnss_positions import HORIZONTAL
from geomosaic.adjustment.terms.image_observations import IMAGE
from geomosaic.camera.interior import Camera
from geomosaic.constants import sourced, tuned
from geomosaic.estimation.robust import median_of_known
from geomosaic.spread import Spread
from geomosaic.survey.model import Warn

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]

GOOD_PX = tuned(
    1.0,
    "px",
    "image errors of a block of which all is given correctly: SIFT's own are 0.3 to 0.7 px of a "
    "image that is matched at its size or half of it",
)
_PATTERN_PX = tuned(
    0.25,
    "px",
    "root mean square of what residuals have in common by their place in the image: half of a "
    "keypoint's own error",
)
_EXPLAINED: float = sourced(
    0.5**0.5,
    "share of the residuals of left-out points",
    "that models together have to stay below where what they leave is more than GOOD_PX: half of the "
    "squares. What no model explains there is land that moves, alike from neighbour to neighbour, and a "
    "camera that may turn and be read in time follows some of it",
    "docs/results.md, surveys as people deliver them: seed 839, all its land in the wind, bent by 3 px "
    "for a gain of 5 to 8 %",
)
_TOO_FEW = tuned(100, "tracks", "with fewer nothing is chosen: twenty would judge")
_LEAST_PX = sourced(
    0.03,
    "px",
    "of tracks left out: nothing is to be gained below. Above it a shutter may hide though all looks "
    "well, or turns that no gyroscope reports or not well enough: along straight lines a shutter only "
    "stretches the block, and the principal point takes up how frames turn while they are read. 3 "
    "degrees a second over a readout of 0.1 s bent a block by 8 px and left 0.2 px at its tracks",
    "docs/results.md, surveys as people deliver them: seed 792, bent by 1.1 px, left 0.098",
)
_CONTRADICTS = tuned(
    1.2,
    "times as much",
    "that positions may fit worse by: beyond, they are against a model, however well it pleases the "
    "tie points; a block that is bent or stretched pleases them too",
)
_LEAST_SCATTER = tuned(0.2, "share of what is stated", "of positions; less is the luck of a few dozen")
_SLOWEST_READOUT_S = sourced(
    0.2,
    "s",
    "the slowest sensors of small cameras take 0.16 s: a solve that wants more bends something else with it",
    "a Sequoia's LineReadoutTime: 0.164 s",
)
_SHOWN = sourced(
    5.0,
    "deviations",
    "by which the solution would leave a readout of none: cameras that read all rows at once came to "
    "3 at most, since image errors are alike along a track; see `bundle._with_unreported_shutters`",
    "docs/results.md, surveys as people deliver them",
)
_NO_GUSTS = sourced(
    2.0,
    "times GUST_M_PER_S",
    "root mean square, from which on rates that stand for what velocities are off by are frames that "
    "turn: 0.1 to 1.3 in twelve surveys whose frames do not, 2.1 and more in six whose frames do",
    "docs/results.md, surveys as people deliver them: seed 1727, 0.84 px off with rates of 2.3, with "
    "swings 0.38",
)
_GIVEN = "given"
_TEXTS = {
    "lens": "the lens free of what its maker says",
    "fisheye": "a fisheye lens",
    "readout": "rows read one after the other, their time solved for",
    "turning": "each frame swinging in its own way while its rows are read one after the other",
    "vibrating": "each frame vibrating while its rows are read one after the other",
    "untold_turns": "without the turns that the tags report",
}
_SHOWN_BY = {
    "readout": (
        "no tag reports it, but it stretches each line along its own way, and all images together show it"
    ),
    "turning": "they turn faster than what is unknown of their velocities explains",
}


def chosen_model(
    block: Block, settings: Settings, tracks: Tracks, first: Solution, spread: Spread
) -> tuple[Block, Settings, ModelChoice | None, Start]:
    """Block and settings of the model to solve with, how it was chosen, None where the given one is good
    from the start, and what its solve begins from.

    What is missing is added one by one, each time what helps most, as long as it helps by a twentieth; what
    makes it worse by as much, or asks for what the block does not determine, is not tried again. Every model
    is judged on the same tracks, which took no part in its solve, track by track (`Judged.beside`), all that
    are tried beside one another at once.

    Args: first: the solution as given, by these tracks.
    """
    good = first.components[IMAGE] <= GOOD_PX and _pattern_px(block, tracks, first) <= _PATTERN_PX
    if _moving(block) and not settings.turning:
        good = good and median_of_known(np.linalg.norm(first.residual_px, axis=1)) <= _LEAST_PX
    if good or tracks.points < _TOO_FEW:
        return block, settings, None, first
    left_out = LeftOut(block, tracks, first, spread)
    now = Model(block, settings, left_out.begun, same=True)
    taken: tuple[str, ...] = ()
    worse: set[str] = set()
    vibrating = left_by_vibration(_image_residuals(tracks, first), block.cameras) < BETTER
    candidates = dict(_candidates(now, taken, vibrating))
    more = left_out.judged("models", {_GIVEN: now} | candidates)
    its = more.pop(_GIVEN)
    now_px = its.median_px
    left_px, contradicted = {_GIVEN: now_px}, []
    while now_px > _LEAST_PX:
        share = {name: model.beside(its)[0] for name, model in more.items()}
        in_vain = {name for name, model in more.items() if name == "readout" and _in_vain(now.block, model)}
        worse |= {name for name in share if BETTER * share[name] > 1.0} | in_vain
        left = {n: m.median_px if its.solved is None else share[n] * now_px for n, m in more.items()}
        left_px |= {"+".join((*taken, name)): px for name, px in left.items()}
        for name in [name for name, model in more.items() if contradicts(model.solved, its.solved)]:
            if more.pop(name).beats(its):
                contradicted.append("+".join((*taken, name)))
        better = [name for name, model in more.items() if name not in in_vain and model.beats(its)]
        if not better:
            break
        least = more[min(better, key=lambda name: share[name])]
        best = next(name for name in better if not least.beats(more[name]))
        taken, its, now_px = (*taken, best), more[best], left[best]
        now = replace(candidates[best], before=its.solved or now.before)
        vibrating = vibrating or its.vibration < BETTER
        candidates = {n: model for n, model in _candidates(now, taken, vibrating) if n not in worse}
        more = left_out.judged(f"models-{len(taken)}", candidates) if candidates else {}
    if now_px > max(GOOD_PX, _EXPLAINED * left_px[_GIVEN]):
        now, taken = Model(block, settings, first), ()
    choice = ModelChoice(taken, tuple(left_px), tuple(left_px.values()), tuple(contradicted))
    return now.block, now.settings, choice, now.before


def contradicts(its: Start | None, now: Start | None) -> bool:
    """Whether a model's solution can't be beside the one so far: positions fit worse by it, or rows are read
    slower than any sensor reads them, or in negative time."""
    if its is None or now is None:
        return False
    scattered = its.components[HORIZONTAL] > _CONTRADICTS * max(now.components[HORIZONTAL], _LEAST_SCATTER)
    return scattered or any(not 0.0 <= c.readout_s <= _SLOWEST_READOUT_S for c in its.cameras)


def _in_vain(block: Block, its: Judged) -> bool:
    """Whether none of the readouts that a model asks for is determined by the block: what it gains is chance,
    as where most tie points move in the wind."""
    if its.solved is None:
        return False
    number = {c.name: k for k, c in enumerate(its.solved.cameras)}
    asked = [number[c.name] for c in block.cameras if not c.readout_s]
    held = its.solved.held[: len(number) * len(INTERIOR)].reshape(-1, len(INTERIOR))
    return bool(held[asked, READOUT].all())


def with_readout(block: Block, settings: Settings) -> tuple[Block, Settings]:
    """The model with rows read one after the other, where no tag reports how long."""
    turns = block.poses.turns
    begin_s = NOMINAL_READOUT_S if turns is None else turns.span_s
    cameras = tuple(c if c.readout_s else replace(c, readout_s=begin_s) for c in block.cameras)
    return replace(block, cameras=cameras), replace(settings, rolling_shutter=True)


def readout_shown(solved: Solution) -> bool:
    """Whether the images show that rows are read one after the other, though nothing reports it."""
    return bool((solved.readout_score > _SHOWN).any())


def turns_shown(solved: Solution) -> bool:
    """Whether rates of turning that stand for what velocities are off by are larger than these are: then
    frames do turn while they are read, and a constant rate is too little, though left-out points may not show
    that (seed 986, bent by 1.4 px by swings that left 0.1 px)."""
    return bool(solved.estimate.swing_rad.shape[1]) and solved.components["swing 1"] >= _NO_GUSTS


def model_warnings(block: Block, choice: ModelChoice | None) -> list[Warn]:
    """A line if something other than the given was needed, and one if how frames turn is the images' word
    alone or can't be determined; not where a gyroscope's record leaves but its last rows to them."""
    out: list[Warn] = []
    judged = () if choice is None else choice.taken[: len(choice.taken) - choice.shown]
    if choice is not None and choice.shown:
        name = choice.taken[-1]
        out.append(Warn("model-chosen", "", f"{_TEXTS[name]}: {_SHOWN_BY[name]}"))
    if choice is not None and judged:
        its = [name for name in judged if name != "turning" or "vibrating" not in judged]
        before, after = (choice.left_out_px[choice.names.index(n)] for n in (_GIVEN, "+".join(judged)))
        text = (
            f"lens and shutter as given leave {before:.2g} px at tie points left out of the solve; taken "
            f"instead, with {after:.2g} px: {', '.join(_TEXTS[name] for name in its)}"
        )
        out.append(Warn("model-chosen", "", text))
    turns = block.poses.turns
    incomplete = turns is not None and bool(np.isfinite(turns.recorded_until_s).any())
    if choice is not None and {"turning", "vibrating"} & set(choice.taken) and not incomplete:
        why = "no gyroscope reports how" if block.poses.turns is None else "not as the gyroscope reports"
        text = f"frames turn while their rows are read, and {why}: their shapes are estimated"
        out.append(Warn("shutter-doubtful", "", text))
    elif choice is not None and choice.contradicted:
        what = _TEXTS[choice.contradicted[0].split("+")[-1]]
        text = f"tie points would fit better with {what}, but the positions speak against it; not taken"
        out.append(Warn("shutter-doubtful", "", text))
    return out


def _candidates(now: Model, taken: tuple[str, ...], vibrating: bool) -> Iterator[tuple[str, Model]]:
    """What can be added to a model, the simplest first; vibrating: whether residuals look like it."""
    block, settings = now.block, now.settings
    turns, moving = block.poses.turns, _moving(block)
    rolling, read_settings = with_readout(block, settings)
    read = any(c.readout_s for c in block.cameras)
    makers = any(c.distortion_sd for c in block.cameras)

    def model(block: Block, settings: Settings) -> Model:
        return Model(block, settings, now.before)

    if read and turns is not None:
        yield "untold_turns", model(replace(block, poses=replace(block.poses, turns=None)), settings)
    if makers and not settings.free_lens:
        yield "lens", model(block, replace(settings, free_lens=True))
    all_solved = all(c.readout_s and c.readout_sd_s for c in block.cameras)
    if moving and not settings.rolling_shutter and not all_solved:
        yield "readout", model(rolling, read_settings)
    if not makers and "fisheye" not in taken:
        yield "fisheye", model(replace(block, cameras=tuple(map(_as_fisheye, block.cameras))), settings)
    solved = settings.rolling_shutter or (moving and not read)
    if not settings.turning:
        yield "turning", model(rolling, replace(settings, turning=True, rolling_shutter=solved))
    if vibrating and not settings.vibrating:
        shaken = replace(settings, turning=True, vibrating=True, rolling_shutter=solved)
        yield "vibrating", model(rolling, shaken)


def _moving(block: Block) -> bool:
    return block.poses.velocities_m_per_s is not None or block.poses.turns is not None


def _as_fisheye(camera: Camera) -> Camera:
    if camera.kind == "fisheye":
        return camera
    return replace(camera, kind="fisheye", k1=0.0, k2=0.0, k3=0.0, p1=0.0, p2=0.0)


def _pattern_px(block: Block, tracks: Tracks, solved: Solution) -> float:
    """What residuals have in common by their place in the image, of the worst camera."""
    patterns = residual_patterns(_image_residuals(tracks, solved), block.cameras)
    return max((p.systematic_px for p in patterns), default=0.0)


def _image_residuals(tracks: Tracks, solved: Solution) -> ImageResiduals:
    return ImageResiduals(tracks.frame, tracks.image_px, solved.residual_px, solved.weight)
