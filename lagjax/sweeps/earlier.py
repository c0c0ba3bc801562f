"""Stores in the formats of earlier versions of lagjax: they can be read, and continued without conversion.

    format 1    axes/NAME, values/NAME (points, ...), status/NAME, done (blocks,): one byte per block, no checksums
    format 2    the same with checksums, done (blocks, arrays, 2), and a copy of all metadata
    format 3    arrays in the shape of the axes, named as in xarray: `store`

Names have changed as well: paired axes were `zipped`, layouts "together" or "in turn", the scaled error `departure`.
"""

from typing import Any

from lagjax.sweeps.lanes import Status

LAYOUTS_BEFORE = {"together": "vmap", "in turn": "map"}


def brought_up_to_date(description: dict[str, Any]) -> dict[str, Any]:
    """The description of a store in today's terms; `as_written` keeps the original."""
    if description["fingerprint"]["format"] >= 3:
        return description | {"as_written": description}
    layout = description["fingerprint"]["layout"]
    renamed = {
        "fingerprint": description["fingerprint"] | {"layout": LAYOUTS_BEFORE.get(layout, layout)},
        "paired": description.get("paired", description.get("zipped")),
        "block": [description["block"]],
        "places": places_before(description),
    }
    return description | renamed | {"as_written": description}


def places_before(description: dict[str, Any]) -> dict[str, Any]:
    """The paths of the arrays of a store of format 1 or 2, by content."""
    scaled_error = "scaled_error" if "paired" in description else "departure"
    return {
        "axes": {name: f"axes/{name}" for name in description["names"]},
        "values": {name: f"values/{name}" for name in description["fingerprint"]["values"]},
        "status": {name: f"status/{name}" for name in Status._fields} | {"scaled_error": f"status/{scaled_error}"},
        "marks": "done",
    }
