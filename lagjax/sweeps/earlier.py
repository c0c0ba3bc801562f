"""Stores as lagjax wrote them before: read, and continued as they are.

    format 1    axes/NAME, values/NAME (points, ...), status/NAME, done (blocks,): one byte a block, no checksums
    format 2    the same with checksums, done (blocks, arrays, 2), and a copy of all metadata
    format 3    arrays in the shape of the axes, named as in xarray: `store`

Words have changed as well: axes were `zipped`, lanes "together" or "in turn", the scaled error a `departure`.
"""

from typing import Any

from lagjax.sweeps.lanes import Status

LAYOUTS_BEFORE = {"together": "vmap", "in turn": "map"}


def brought_up_to_date(said: dict[str, Any]) -> dict[str, Any]:
    """What a store says about itself in today's words; `itself` is what it says."""
    if said["fingerprint"]["format"] >= 3:
        return said | {"itself": said}
    layout = said["fingerprint"]["layout"]
    renamed = {
        "fingerprint": said["fingerprint"] | {"layout": LAYOUTS_BEFORE.get(layout, layout)},
        "paired": said.get("paired", said.get("zipped")),
        "block": [said["block"]],
        "places": places_before(said),
    }
    return said | renamed | {"itself": said}


def places_before(said: dict[str, Any]) -> dict[str, Any]:
    """The arrays of a store of format 1 or 2, by what they have."""
    scaled_error = "scaled_error" if "paired" in said else "departure"
    return {
        "axes": {name: f"axes/{name}" for name in said["names"]},
        "values": {name: f"values/{name}" for name in said["fingerprint"]["values"]},
        "status": {name: f"status/{name}" for name in Status._fields} | {"scaled_error": f"status/{scaled_error}"},
        "marks": "done",
    }
