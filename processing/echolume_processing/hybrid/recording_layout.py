"""How a viewer lays the recording out."""

from __future__ import annotations

import rerun as rr
import rerun.blueprint as rrb

GROWING = ("/rig/map/st", "/rig/map/at_left", "/rig/map/at_right", "/rig/map/us")
"""Entities that hold the points of one step; a view shows all up to the cursor."""
TIMELINES = ("scan_step", "rig_time", "utc")


def blueprint() -> rrb.Blueprint:
    """What was measured and where, the map, the cameras, the echoes, and the notes."""
    hidden = rrb.PlotLegend(visible=False)
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(
                _space(
                    "measured", ["/rig/**", "- /rig/map/hybrid", "- /rig/map/behind"], (150.0, -640.0, 480.0), 225.0
                ),
                rrb.Horizontal(
                    rrb.BarChartView(origin="/us/envelope", name="echo over path, mm"),
                    rrb.TimeSeriesView(origin="/us/path", name="path of first echo, mm", plot_legend=hidden),
                    rrb.TimeSeriesView(origin="/us/level", name="echo level, counts", plot_legend=hidden),
                ),
                row_shares=[3, 1],
            ),
            rrb.Vertical(
                _space("map", ["/rig/map/hybrid", "/rig/map/behind"], (40.0, -210.0, 190.0), 5.0),
                rrb.Horizontal(
                    rrb.Spatial2DView(origin="/rig/cam_left", name="left camera"),
                    rrb.Spatial2DView(origin="/rig/cam_right", name="right camera"),
                ),
                rrb.Horizontal(
                    rrb.Tabs(
                        rrb.Spatial2DView(origin="/map/labels", name="labels"),
                        rrb.Spatial2DView(origin="/map/height", name="heights"),
                        rrb.Spatial2DView(origin="/map/probability", name="probability"),
                        rrb.TensorView(origin="/us/echoes", name="raw echoes"),
                    ),
                    rrb.Tabs(
                        rrb.TextDocumentView(origin="/notes", name="notes"),
                        rrb.TextLogView(origin="/log", name="log"),
                    ),
                    column_shares=[2, 3],
                ),
                row_shares=[3, 2, 3],
            ),
            column_shares=[3, 2],
        ),
        rrb.TimePanel(timeline="scan_step", state="collapsed"),
        collapse_panels=True,
    )


def _space(name: str, contents: list[str], eye_mm: tuple[float, float, float], target_z_mm: float) -> rrb.Spatial3DView:
    """A view of the bench, from a place in the rig frame to a point above the bench's middle."""
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
        eye_controls=rrb.EyeControls3D(position=eye_mm, look_target=(0.0, 0.0, target_z_mm), eye_up=(0.0, 0.0, 1.0)),
    )
