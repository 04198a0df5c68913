"""Residuals of attitudes whose headings are far off, and their derivatives."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from adjustment_blocks import fly
from hypothesis import given, settings
from hypothesis import strategies as st

from geomosaic.adjustment.problem.estimate import Estimate, UnknownLayout
from geomosaic.adjustment.terms.attitudes import BORESIGHT, HEADINGS, Attitudes
from geomosaic.adjustment.terms.terrain import level_unknown
from geomosaic.camera.exterior import Poses
from geomosaic.camera.rotation import about_z, exp_turn

PART = (np.arange(3),)


def estimate_of(term: Attitudes, poses: Poses, values: np.ndarray) -> Estimate:
    """Poses and the term's shared unknowns."""
    layout = UnknownLayout((), level_unknown(1.0), term.unknowns())
    none = np.zeros((0, 3)), np.append(0.0, values), np.zeros((3, 0, 3)), np.zeros((3, 3))
    return Estimate(layout, poses.positions_m, poses.rotations, *none)


def reported(poses: Poses, heading_rad: float, tilt_rad: tuple[float, float]) -> Poses:
    """Tilted about east and north, then turned about up."""
    tilted = exp_turn(np.array([[*tilt_rad, 0.0]])) @ poses.rotations
    return replace(poses, rotations=about_z(heading_rad) @ tilted)


@pytest.mark.parametrize("heading_deg", [0.0, 25.0, -120.0, 179.0])
def test_a_wrong_heading_leaves_tilts_as_they_are(heading_deg: float) -> None:
    poses = fly(3, 1, 3, points=20).truth
    heading_rad = np.radians(heading_deg)
    term = Attitudes(reported(poses, heading_rad, (0.02, -0.05)), PART, np.ones((3, 3)))
    miss = term.miss(estimate_of(term, poses, np.zeros(0)))
    assert miss == pytest.approx(np.tile([0.02, -0.05, heading_rad], (3, 1)), abs=1e-9)


ANGLES = st.floats(-3.1, 3.1)


@given(heading_rad=ANGLES, common_rad=ANGLES, boresight=st.booleans())
@settings(max_examples=50, deadline=None)
def test_derivatives_are_those_of_finite_differences(
    heading_rad: float, common_rad: float, boresight: bool
) -> None:
    """For any error of a heading, and any that headings have in common; tilts are off by a milliradian."""
    poses = fly(3, 1, 3, points=20).truth
    given_poses = reported(poses, heading_rad + common_rad * (not boresight), (6e-4, -8e-4))
    group, sd_rad = np.zeros(3, dtype=np.intp), np.array([3.0])
    term = Attitudes(given_poses, PART, np.ones((3, 3)), boresight, group, sd_rad)
    values = np.array([2e-4, -3e-4, 1e-4]) if boresight else np.array([-common_rad])
    at = estimate_of(term, poses, values)
    by_pose, shared = term.derivatives(at)
    assert by_pose is not None
    by = dict(shared)[BORESIGHT if boresight else HEADINGS]

    def slope(step: np.ndarray) -> np.ndarray:
        """Of the residuals by three turns and the shared unknowns."""
        ends = [
            term.miss(
                replace(
                    at,
                    rotations=exp_turn(sign * step[None, :3]) @ at.rotations,
                    shared=at.shared + np.append(0.0, sign * step[3:]),
                )
            )
            for sign in (1.0, -1.0)
        ]
        off = ends[0] - ends[1]
        off[:, 2] = np.angle(np.exp(1j * off[:, 2]))
        return np.asarray(off / 2e-5)

    for k, expected in enumerate([*np.moveaxis(by_pose, 2, 0)[3:], *np.moveaxis(by, 2, 0)]):
        step = np.zeros(3 + len(values))
        step[k] = 1e-5
        assert slope(step) == pytest.approx(-expected, abs=2e-3)
    assert not by_pose[:, :, :3].any()
