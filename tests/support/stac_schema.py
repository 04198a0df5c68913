"""STAC's own JSON schemas, as pystac brings them: of an item, and of the fields that all versions 1.1 share."""

from __future__ import annotations

import json
from typing import Any

from pystac.stac_object import STACObjectType
from pystac.validation.stac_validator import JsonSchemaSTACValidator


def check_schema(item: dict[str, Any]) -> None:
    """Raises: `pystac.errors.STACValidationError`."""
    written = json.loads(json.dumps(item))
    checked = JsonSchemaSTACValidator().validate_core(written, STACObjectType.ITEM, item["stac_version"])
    assert checked is not None and checked.endswith("v1.1.0/item-spec/json-schema/item.json")
