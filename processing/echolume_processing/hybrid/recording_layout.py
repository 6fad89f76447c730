"""How a viewer lays the recording out."""

from __future__ import annotations

import rerun as rr
import rerun.blueprint as rrb

GROWING = ("/rig/map/st", "/rig/map/at_left", "/rig/map/at_right", "/rig/map/us")
"""Entities that hold the points of one step; a view shows all up to the cursor."""
TIMELINES = ("scan_step", "rig_time", "utc")


def blueprint() -> rrb.Blueprint:
    """What was measured and where, the map, the cameras, the echoes, and the notes."""
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(
                _space("measured", ["/rig/**", "- /rig/map/hybrid", "- /rig/map/behind"]),
                rrb.Horizontal(
                    rrb.BarChartView(origin="/us/envelope", name="echo over path, mm"),
                    rrb.TimeSeriesView(origin="/us/path", name="path of first echo, mm"),
                    rrb.TimeSeriesView(origin="/us/level", name="echo level, counts"),
                ),
                row_shares=[3, 1],
            ),
            rrb.Vertical(
                _space("map", ["/rig/map/hybrid", "/rig/map/behind"]),
                rrb.Horizontal(
                    rrb.Spatial2DView(origin="/rig/cam_left", name="left camera"),
                    rrb.Spatial2DView(origin="/rig/cam_right", name="right camera"),
                ),
                rrb.Tabs(
                    rrb.TextDocumentView(origin="/notes", name="notes"),
                    rrb.Spatial2DView(origin="/map/labels", name="labels"),
                    rrb.Spatial2DView(origin="/map/height", name="heights"),
                    rrb.TensorView(origin="/us/echoes", name="raw echoes"),
                    rrb.TextLogView(origin="/log", name="log"),
                ),
                row_shares=[3, 2, 2],
            ),
            column_shares=[3, 2],
        ),
        rrb.TimePanel(timeline="scan_step", state="collapsed"),
        collapse_panels=True,
    )


def _space(name: str, contents: list[str]) -> rrb.Spatial3DView:
    """A view of the bench from above its front edge."""
    ranges = [
        rrb.VisibleTimeRange(
            timeline, start=rr.TimeRangeBoundary.infinite(), end=rr.TimeRangeBoundary.cursor_relative(seq=0)
        )
        for timeline in TIMELINES
    ]
    return rrb.Spatial3DView(
        origin="/",
        contents=contents,
        name=name,
        overrides={entity: rrb.VisibleTimeRanges(ranges) for entity in GROWING},
        eye_controls=rrb.EyeControls3D(position=(60.0, -380.0, 330.0), look_target=(0.0, 0.0, 20.0)),
    )
