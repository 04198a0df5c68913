"""Names of earlier versions stay readable for one release."""

from __future__ import annotations

import pytest
from typer.testing import CliRunner

from geomosaic.adjustment.model import ModelChoice
from geomosaic.cli.app import build_app
from geomosaic.cli.declared import option_values, recipe_of_options
from geomosaic.pipeline.registry import installed
from geomosaic.recording.inspect.worst import _FIXES, FORMER_CODES, _of_frames
from geomosaic.runs import Judgement
from geomosaic_simulate.dirty import FAULTS, dirty_survey

SIMULATED = installed().get("simulate.frames")


def test_a_judgement_has_its_fix_by_its_former_name() -> None:
    judged, former = Judgement("bad", "few frames", "fly again"), "mend"
    with pytest.warns(DeprecationWarning, match=r"Judgement\.fix"):
        assert getattr(judged, former) == judged.fix
    assert not hasattr(judged, "cause")


@pytest.mark.parametrize("former", FORMER_CODES)
def test_warnings_of_an_earlier_recording_are_understood(former: str) -> None:
    assert FORMER_CODES[former] in _FIXES
    (fault,) = _of_frames([(former, "a.jpg", "of an earlier version")], {}, ())
    assert fault.code == FORMER_CODES[former]


def test_models_of_an_earlier_recording_have_their_present_names() -> None:
    former = "untold_turns"
    choice = ModelChoice((former,), ("given", f"lens+{former}"), (0.5, 0.4))
    assert choice.taken == ("without_reported_turns",)
    assert choice.names == ("given", "lens+without_reported_turns")


@pytest.mark.parametrize("former, present", SIMULATED.Params.FORMERLY.items())
def test_options_of_the_simulator_have_former_names(former: str, present: str) -> None:
    assert option_values(SIMULATED, {former: False, present: None}) == {present: False}
    assert recipe_of_options(SIMULATED, {former: True}, 0) == recipe_of_options(SIMULATED, {present: True}, 0)


def test_former_options_are_accepted_and_not_shown() -> None:
    app, asked = build_app(["simulate"]), ["simulate", "frames", "--help-all"]
    shown = CliRunner().invoke(app, asked).output
    assert "--no-lens-reported" in shown and "--no-lens-told" not in shown
    result = CliRunner().invoke(app, ["simulate", "frames", "--no-lens-told", "--help"])
    assert result.exit_code == 0


def test_faults_of_simulated_surveys_have_former_names() -> None:
    for fault in FAULTS:
        if fault.former:
            assert fault.name not in dirty_survey(3, without=[fault.former]).faults
