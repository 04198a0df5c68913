"""Normal equations of tones against the dense ones, with a brightness of its own for each place."""

import numpy as np
import pytest
from scipy.sparse import csr_matrix, diags

from geomosaic.composition.tone_equations import OF_A_FRAME, ToneDesign


def _design(seed: int, sightings: int = 200, frames: int = 9, places: int = 70) -> ToneDesign:
    """Sightings of frames that meet only their neighbours; some places and one frame are not seen at all."""
    rng = np.random.default_rng(seed)
    frame = np.sort(rng.integers(0, frames - 1, sightings))
    place = (frame * 8 + rng.integers(0, 14, sightings)) % places
    _, first = np.unique(np.column_stack([frame, place]), axis=0, return_index=True)
    frame, place = frame[first], place[first]
    own = np.column_stack([np.ones(len(frame)), rng.uniform(-1.0, 1.0, (len(frame), 2))])
    return ToneDesign(frame, place, own, rng.uniform(0.0, 1.0, (len(frame), 2)), frames, places)


def _dense(design: ToneDesign) -> np.ndarray:
    """Derivatives (m, u + p) by the unknowns and by the places' brightness."""
    m = len(design.frame)
    out = np.zeros((m, design.unknowns + design.places))
    for k in range(OF_A_FRAME):
        out[np.arange(m), OF_A_FRAME * design.frame + k] = design.own[:, k]
    out[:, OF_A_FRAME * design.frames : design.unknowns] = design.shared
    out[np.arange(m), design.unknowns + design.place] = 1.0
    return out


@pytest.mark.parametrize("seed", range(3))
def test_the_solution_is_that_of_the_dense_equations_with_each_places_brightness(seed: int) -> None:
    design = _design(seed)
    rng = np.random.default_rng(seed + 10)
    u, m = design.unknowns, len(design.frame)
    weight, logs = rng.uniform(0.5, 2.0, m), rng.normal(0.0, 1.0, m)
    priors = diags(rng.uniform(0.1, 1.0, u)).tolil()
    priors[0, u - 1] = priors[u - 1, 0] = 0.02
    all_of_them, seen = _dense(design), np.bincount(design.place, minlength=design.places) > 0
    kept = np.concatenate([np.ones(u, bool), seen])
    whole = (all_of_them.T * weight) @ all_of_them
    whole[:u, :u] += priors.toarray()
    wanted = np.linalg.solve(whole[np.ix_(kept, kept)], (all_of_them.T @ (weight * logs))[kept])[:u]
    side = design.summed(weight * (logs - design.means(weight, logs)))
    found = design.normal(weight, csr_matrix(priors)).solve(side)
    assert found == pytest.approx(wanted, rel=1e-8, abs=1e-10)
    assert design.logs(found) == pytest.approx(all_of_them[:, :u] @ wanted, abs=1e-8)
    assert design.summed(logs) == pytest.approx(all_of_them[:, :u].T @ logs)


def test_combinations_of_gains_and_of_what_is_shared_keep_their_unknowns() -> None:
    design = _design(0)
    n = design.frames
    rows = csr_matrix(np.concatenate([np.diag(np.arange(1.0, n + 1)), np.full((n, 1), -2.0)], axis=1))
    placed = design.of_gains(rows).toarray()
    assert placed[2, OF_A_FRAME * 2] == 3.0
    assert (placed[:, OF_A_FRAME * n] == -2.0).all()
    assert np.count_nonzero(placed) == 2 * n


def test_some_of_the_sightings_keep_their_unknowns() -> None:
    design = _design(1)
    mine = design.place % 2 == 0
    unknowns = np.arange(float(design.unknowns))
    assert design.of(mine).logs(unknowns) == pytest.approx(design.logs(unknowns)[mine])


def test_without_sightings_there_are_no_means() -> None:
    design = _design(0)
    none = design.of(np.zeros(len(design.frame), dtype=bool))
    assert none.means(np.zeros(0), np.zeros((0, 3))).shape == (0, 3)
