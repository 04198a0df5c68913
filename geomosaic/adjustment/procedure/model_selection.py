"""Which model of lens and shutter a block is solved with: the one that predicts tie points left out best."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from geomosaic.adjustment.kernels.interior import INTERIOR, READOUT
from geomosaic.adjustment.model import Block, ImageResiduals, ModelChoice, Settings
from geomosaic.adjustment.procedure.block_problem import CRUISE_M_PER_S, velocities_known
from geomosaic.adjustment.procedure.cross_validation import BETTER, LeftOutTracks, Model, ModelScore, tested
from geomosaic.adjustment.procedure.residual_pattern import left_by_vibration, residual_patterns
from geomosaic.adjustment.solver.solution import Solution, Start
from geomosaic.adjustment.terms.gnss_positions import HORIZONTAL
from geomosaic.adjustment.terms.image_observations import IMAGE
from geomosaic.adjustment.terms.interior_orientation import NOMINAL_READOUT_S
from geomosaic.camera.interior import Camera
from geomosaic.constants import sourced, tuned
from geomosaic.estimation.robust import median_of_known
from geomosaic.matching.tracks import Tracks
from geomosaic.placement.prior import position_assumed
from geomosaic.spread import Spread
from geomosaic.survey.model import Warn

GOOD_PX = tuned(1.0, "px", "image deviation of a block with all given correctly: SIFT's is 0.3 to 0.7 px")
_PATTERN_PX = tuned(0.25, "px", "RMS of residuals common to a place in the image: half of a keypoint's")
_EXPLAINED = tuned(0.5**0.5, "share of left-out residuals", "more: moving land chooses a model")
_TOO_FEW = tuned(100, "tracks", "with fewer nothing is chosen: twenty would judge")
_LEAST_PX = tuned(0.03, "px", "residuals with nothing to gain: a shutter that bends by 1 px may leave 0.1")
_CONTRADICTS = tuned(1.2, "times", "that positions may fit worse by: with more, bent blocks are taken")
_LEAST_SCATTER = tuned(0.2, "share of the stated", "deviation of positions: less is the luck of a few dozen")
_SLOWEST_READOUT_S = sourced(0.2, "s", "beyond the slowest sensors of small cameras", "Sequoia: 0.164 s")
_SHOWN = tuned(5.0, "deviations", "of a readout that the images show: global shutters came to 3")
_NO_GUSTS = tuned(2.0, "times GUST_M_PER_S", "rates of frames that turn: steady ones came to 1.3 at most")
_MAY_WIN = tuned(0.98, "share of left-out residuals", "after some steps: less loses models that gain slowly")
_ALIKE = tuned(0.7, "of a simpler model's", "residuals that the best leaves: more misses simpler models")
_GIVEN = "given"
_LENSES = {"lens", "fisheye"}
_TEXTS = {
    "lens": "the lens free of what its maker says",
    "fisheye": "a fisheye lens",
    "readout": "rows read one after the other, their time solved for",
    "turning": "each frame turning in its own way while its rows are read one after the other",
    "vibrating": "each frame vibrating while its rows are read one after the other",
    "without_reported_turns": "without the turns that the tags report",
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
    """Block and settings of the model to solve with, how it was chosen (None where the given one is good from
    the start), and the start of its solve.

    What is missing is added one by one, each time what helps most, as long as it helps by a twentieth. Every
    model is judged on the same tracks, which took no part in its solve, track by track
    (`ModelScore.compared_to`). Some steps from the solution so far show which models may win; only the best
    of these is solved, and a simpler one that does about as well. A lens that does worse is not tried again.
    Args: first: the solution as given, by these tracks.
    """
    good = first.components[IMAGE] <= GOOD_PX and _pattern_px(block, tracks, first) <= _PATTERN_PX
    if _moving(block) and not settings.turning:
        good = good and median_of_known(np.linalg.norm(first.residual_px, axis=1)) <= _LEAST_PX
    if good or tracks.points < _TOO_FEW:
        return block, settings, None, first
    left_out = LeftOutTracks(block, tracks, first, spread)
    now = Model(block, settings, left_out.begun)
    its = left_out.judged("models", {_GIVEN: now})[_GIVEN]
    now, now_px = replace(now, before=its.solved or now.before), its.median_px
    left_px, contradicted = {_GIVEN: now_px}, []
    taken: tuple[str, ...] = ()
    in_vain: set[str] = set()
    vibrating = left_by_vibration(image_residuals(tracks, first), block.cameras) < BETTER
    while now_px > _LEAST_PX:
        candidates = {n: model for n, model in _candidates(now, vibrating) if n not in in_vain}
        found = _compared(left_out, f"models of step {len(taken) + 1}", now.block, candidates, its)
        worse = {n for n, model in found.judged.items() if model.compared_to(its)[0] > 1.0 / _MAY_WIN}
        in_vain |= found.in_vain | (_LENSES & worse)
        left = {
            name: model.median_px if its.solved is None else model.compared_to(its)[0] * now_px
            for name, model in found.judged.items()
        }
        left_px |= {"+".join((*taken, name)): px for name, px in left.items()}
        contradicted += ["+".join((*taken, name)) for name in found.contradicted]
        if not found.better:
            break
        least = found.judged[min(found.better, key=lambda name: found.judged[name].compared_to(its)[0])]
        best = next(name for name in found.better if not least.beats(found.judged[name]))
        taken, its, now_px = (*taken, best), found.judged[best], left[best]
        now = replace(candidates[best], before=its.solved or now.before)
        vibrating = vibrating or its.vibration < BETTER
    whole = left_out.of_whole(now.before)
    if now_px > max(GOOD_PX, _EXPLAINED * left_px[_GIVEN]):
        now, whole, taken = Model(block, settings, first), first, ()
    choice = ModelChoice(taken, tuple(left_px), tuple(left_px.values()), tuple(contradicted))
    return now.block, now.settings, choice, whole


@dataclass(frozen=True)
class _Compared:
    """What each candidate leaves; those that are better, that would be but that positions contradict, and
    that ask for what the block does not determine."""

    judged: dict[str, ModelScore]
    better: list[str]
    contradicted: list[str]
    in_vain: set[str]


def _compared(
    left_out: LeftOutTracks, name: str, now: Block, candidates: dict[str, Model], its: ModelScore
) -> _Compared:
    """Candidates some steps from the solution so far. Solved are the simplest that none is better than by
    these steps, and a simpler one if it may do as well; then others as long as these are rejected."""
    judged = left_out.judged(f"{name}, a few iterations", candidates, tested) if candidates else {}
    share = {n: test.compared_to(its)[0] for n, test in judged.items()}
    may_win = [n for n in candidates if share[n] < _MAY_WIN]
    out = _Compared(judged, [], [], set())
    while may_win and not out.better:
        best = min(may_win, key=lambda n: share[n])
        first = next(n for n in may_win if BETTER * share[n] <= share[best])
        simpler = [n for n in may_win[: may_win.index(first)] if _ALIKE * share[n] < share[best]]
        solved = [*sorted(simpler, key=lambda n: share[n])[:1], first]
        begun = {n: replace(candidates[n], before=judged[n].solved or candidates[n].before) for n in solved}
        more = left_out.judged(f"{name}, best of {len(may_win)}", begun)
        judged.update(more)
        in_vain = {n for n in more if n == "readout" and _in_vain(now, more[n])}
        against = {n for n in more if contradicts(more[n].solved, its.solved)}
        out.in_vain.update(in_vain)
        out.contradicted.extend(n for n in solved if n in against and more[n].beats(its))
        out.better.extend(n for n in solved if n not in in_vain | against and more[n].beats(its))
        if best in solved and best not in in_vain | against:
            break
        may_win = [n for n in may_win if n not in solved]
    return out


def contradicts(its: Start | None, now: Start | None) -> bool:
    """Whether a model's solution is impossible by the one so far: positions fit worse, or a readout time is
    negative or longer than any sensor's."""
    if its is None or now is None:
        return False
    scattered = its.components[HORIZONTAL] > _CONTRADICTS * max(now.components[HORIZONTAL], _LEAST_SCATTER)
    return scattered or any(not 0.0 <= c.readout_s <= _SLOWEST_READOUT_S for c in its.cameras)


def _in_vain(block: Block, its: ModelScore) -> bool:
    """Whether the block determines none of the readouts that a model asks for: its gain is chance."""
    if its.solved is None:
        return False
    number = {c.name: k for k, c in enumerate(its.solved.cameras)}
    asked = [number[c.name] for c in block.cameras if not c.readout_s]
    fixed = its.solved.fixed[: len(number) * len(INTERIOR)].reshape(-1, len(INTERIOR))
    return bool(fixed[asked, READOUT].all())


def with_readout(block: Block, settings: Settings) -> tuple[Block, Settings]:
    """The model with rows read one after the other, where no tag reports how long."""
    turns = block.poses.turns
    begin_s = NOMINAL_READOUT_S if turns is None else turns.span_s
    cameras = tuple(c if c.readout_s else replace(c, readout_s=begin_s) for c in block.cameras)
    return replace(block, cameras=cameras), replace(settings, rolling_shutter=True)


def readout_shown(solved: Solution) -> bool:
    """Whether the images show that rows are read one after the other, though nothing reports it."""
    return bool((solved.readout_score > _SHOWN).any())


def turns_shown(solved: Solution, block: Block) -> bool:
    """Whether estimated rates of rotation are larger than errors of the velocities explain: then frames do
    rotate while they are read, though left-out points may not show that. Unknown velocities explain all."""
    rates = bool(solved.estimate.rotation_terms_rad.shape[1]) and velocities_known(block).mean() > 0.5
    return rates and solved.components["rotation term 1"] >= _NO_GUSTS


def model_warnings(block: Block, choice: ModelChoice | None) -> list[Warn]:
    """A line if something other than the given was needed, and one if rotations while rows are read are not
    determined or known by the images alone. The second is left out where a gyroscope's record leaves only its
    last rows to the images."""
    out: list[Warn] = []
    read = [abs(c.readout_s) / c.height_px for c in block.cameras if c.readout_s]
    anchored = bool(block.control) or not position_assumed(block.poses).all()
    if read and not anchored and block.poses.turns is None and velocities_known(block).mean() <= 0.5:
        share = 100.0 * CRUISE_M_PER_S * max(read) / block.ground_pixel_m
        text = f"at {CRUISE_M_PER_S:g} m/s the map would be stretched by {share:.1f} % along the lines"
        text = f"rolling shutter, and neither times nor tags say how fast the frames flew: {text}; give "
        text += "positions with --pos, or control points with --gcp"
        out.append(Warn("velocity-unknown", "", text))
    if choice is None:
        return out
    count = len(choice.taken) - choice.shown
    judged, shown = choice.taken[:count], choice.taken[count:]
    out += [Warn("model-chosen", "", f"{_TEXTS[name]}: {_SHOWN_BY[name]}") for name in shown]
    if judged:
        its = [name for name in judged if name != "turning" or "vibrating" not in judged]
        before, after = (choice.left_out_px[choice.names.index(n)] for n in (_GIVEN, "+".join(judged)))
        text = (
            f"lens and shutter as given leave {before:.2g} px at tie points left out of the solve; taken "
            f"instead, with {after:.2g} px: {', '.join(_TEXTS[name] for name in its)}"
        )
        out.append(Warn("model-chosen", "", text))
    turns = block.poses.turns
    incomplete = turns is not None and bool(np.isfinite(turns.recorded_until_s).any())
    if {"turning", "vibrating"} & set(choice.taken) and not incomplete:
        why = "no gyroscope reports how" if block.poses.turns is None else "not as the gyroscope reports"
        text = f"frames turn while their rows are read, and {why}: their shapes are estimated; "
        text += "measure check points (--gcp) to be sure of the map"
        out.append(Warn("shutter-doubtful", "", text))
    elif choice.contradicted:
        what = _TEXTS[choice.contradicted[0].split("+")[-1]]
        text = f"not taken, as the positions contradict it, though tie points fit better: {what}; "
        text += "give a calibrated lens with --camera, or control points with --gcp"
        out.append(Warn("shutter-doubtful", "", text))
    return out


def _candidates(now: Model, vibrating: bool) -> Iterator[tuple[str, Model]]:
    """What can be added to a model, the simplest first; vibrating: whether residuals look like it."""
    block, settings = now.block, now.settings
    turns, moving = block.poses.turns, _moving(block)
    rolling, read_settings = with_readout(block, settings)
    read = any(c.readout_s for c in block.cameras)
    makers = any(c.distortion_sd for c in block.cameras)

    def model(block: Block, settings: Settings) -> Model:
        return Model(block, settings, now.before)

    if read and turns is not None:
        yield (
            "without_reported_turns",
            model(replace(block, poses=replace(block.poses, turns=None)), settings),
        )
    if makers and not settings.free_lens:
        yield "lens", model(block, replace(settings, free_lens=True))
    all_solved = all(c.readout_s and c.readout_sd_s for c in block.cameras)
    if moving and not settings.rolling_shutter and not all_solved:
        yield "readout", model(rolling, read_settings)
    if not makers and any(c.kind != "fisheye" for c in block.cameras):
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
    patterns = residual_patterns(image_residuals(tracks, solved), block.cameras)
    return max((p.systematic_px for p in patterns), default=0.0)


def image_residuals(tracks: Tracks, solved: Solution) -> ImageResiduals:
    """Those of a solution's tie points."""
    return ImageResiduals(tracks.frame, tracks.image_px, solved.residual_px, solved.weight)
