"""The solution of an earlier run, as a later one reads it."""

import io
import json
import zipfile
from dataclasses import replace

import numpy as np
from adjustment_blocks import fly

from geomosaic.adjustment.methods import METHODS
from geomosaic.adjustment.model import Settings, SolvedBlock
from geomosaic.adjustment.procedure.block_part import part_of_block
from geomosaic.pipeline.artefact_reader import decode
from geomosaic.pipeline.artefacts import TIMELESS, TREE, encode


def test_a_solution_of_an_earlier_version_is_read() -> None:
    """Its rotation while rows are read had another name, as field and as variance component, and it stated
    how the model was chosen."""
    found = METHODS["bundle"](part_of_block(fly(4).block, np.arange(12)), Settings(model="given")).solved
    assert found is not None
    solved = replace(found, components={"image": 0.3, "rotation term 1": 0.5})
    former = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(encode(solved))) as now, zipfile.ZipFile(former, "w") as then:
        for name in now.namelist():
            member = now.read(name)
            if name == TREE:
                tree = json.loads(member.replace(b'"rotation term 1"', b'"swing 1"'))
                tree["fields"]["swing_rad"] = tree["fields"].pop("rotation_terms_rad")
                tree["fields"]["choice"] = {"is": "ModelChoice", "fields": {}}
                member = json.dumps(tree).encode()
            then.writestr(zipfile.ZipInfo(name, TIMELESS), member)
    read = decode(former.getvalue(), SolvedBlock)
    assert read.components == solved.components
    assert (read.rotation_terms_rad == solved.rotation_terms_rad).all()
