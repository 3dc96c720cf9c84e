"""Centre lines, widths and heights of the lanes of an OpenDRIVE network, all at once.

The projection is flat: lanes are laid out by their lateral position t across a level road, as in CARLA and esmini's
plan view; superelevation changes their height alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ssad.core.import_report import ImportReport
from ssad.core.types import F64
from ssad.world.roads.reference_line import Cubics, Index, ReferenceLines
from ssad.world.roads.xodr import Lane, Network, Outline, Placement

STEP = 0.5  # m between samples
NUDGE = 1e-3  # m, so that a sample belongs to its own section
GAP = 0.05  # m between two pieces of a reference line that is worth a word
LENGTH_ERROR = 0.01  # share of its length by which a polynomial curve may be longer or shorter than the file says
LONG_ERROR = 0.1  # m, the same for long curves

Key = tuple[int, int, int]  # road, section, lane id


@dataclass(frozen=True)
class LaneSamples:
    """Samples of lanes, lane by lane.

    Attributes:
        first: Samples of lane i are first[i]:first[i+1] [L+1], in the direction of traffic.
        s: Position along the road [P], m.
        xy: [P, 2], m.
        z: [P], m.
        yaw: Direction of the traffic [P], rad.
        tangent: As `yaw`, up to a constant, with the slope of the lane in the road's frame in place of its angle [P]:
            thinning by it keeps the points that towns have always had.
        width: [P], m.
        folded: Lanes that run backwards somewhere, inside the centre of their curve [L].
    """

    first: Index
    s: F64
    xy: F64
    z: F64
    yaw: F64
    tangent: F64
    width: F64
    folded: npt.NDArray[np.bool_]


class LaneSampler:
    """Geometry of a network."""

    def __init__(self, network: Network) -> None:
        self.network = network
        roads = list(network.roads.values())
        self.row = {road.id: row for row, road in enumerate(roads)}
        self.reference = ReferenceLines([road.plan for road in roads])
        self.offset = Cubics([road.offsets for road in roads])
        self.elevation = Cubics([road.elevations for road in roads])
        self.superelevation = Cubics([road.superelevations for road in roads])

    def check(self, report: ImportReport) -> None:
        """Report gaps in reference lines, and curves that are not as long as the file says."""
        roads = list(self.network.roads)
        for row, s, gap in self.reference.gaps():
            if gap > GAP:
                report.doubt("the pieces of a reference line do not meet", f"road {roads[row]}, s {s:.1f}: {gap:.2f} m")
        for row, s, length, arc_length in self.reference.length_errors():
            if abs(arc_length - length) > min(LENGTH_ERROR * length + 0.01, LONG_ERROR):
                report.doubt(
                    "a polynomial curve is not as long as the file says",
                    f"road {roads[row]}, s {s:.1f}: {arc_length:.2f}, {length:.2f} m",
                )
        if any(
            record[1:] != (0.0, 0.0, 0.0, 0.0)
            for road in self.network.roads.values()
            for record in road.superelevations
        ):
            report.contents.append("superelevation is kept in the heights; the plan is that of level roads")

    def road_ends(self) -> F64:
        """Return x and y of the start and the end of each reference line [R, 2, 2]."""
        count = len(self.row)
        lengths = np.array([road.length for road in self.network.roads.values()])
        ends = [np.stack(self.at(np.arange(count), s, np.zeros(count))[:2], 1) for s in (np.zeros(count), lengths)]
        return np.stack(ends, 1)

    def at(self, road: Index, s: F64, t: F64) -> tuple[F64, F64, F64]:
        """Return x, y and heading of the road [n] at s [n] and t [n] of roads [n]; t is measured from its plan view."""
        x, y, heading, _ = self.reference.evaluate(road, s)
        return x - t * np.sin(heading), y + t * np.cos(heading), heading

    def lanes(self, keys: Sequence[Key]) -> LaneSamples:
        """Sample lanes.

        Args:
            keys: All lanes of each section, section by section.
        """
        section_keys = list(dict.fromkeys(key[:2] for key in keys))
        section_row = {key: row for row, key in enumerate(section_keys)}
        sections = [self.network.roads[road].sections[index] for road, index in section_keys]
        start, end, base = (
            np.array([(section.s0, section.s1, section.base) for section in sections], np.float64).reshape(-1, 3).T
        )
        pieces = np.maximum(np.ceil((end - start) / STEP), 1.0).astype(np.int64)
        counts = np.where(end - start > 4.0 * NUDGE, pieces + 1, 0)
        section_first = np.concatenate([[0], np.cumsum(counts)])
        section = np.repeat(np.arange(len(sections)), counts)
        step = np.arange(section_first[-1]) - section_first[section]
        s = start[section] + NUDGE + (end - start - 2.0 * NUDGE)[section] * step / pieces[section]
        road = np.array([self.row[road] for road, _ in section_keys], np.int64)[section]
        x, y, heading, curvature = self.reference.evaluate(road, s)
        offset, offset_slope = self.offset(road, s)

        lane_section = np.array([section_row[key[:2]] for key in keys], np.int64)
        lane_counts = counts[lane_section]
        first = np.concatenate([[0], np.cumsum(lane_counts)])
        lane = np.repeat(np.arange(len(keys)), lane_counts)
        sample = np.arange(first[-1]) - first[lane] + section_first[lane_section[lane]]
        entries = [sections[row].lanes[key[2]] for row, key in zip(lane_section.tolist(), keys, strict=True)]
        inner, outer, slope = self._boundaries(
            keys, lane_section, entries, first, lane, s[sample] - base[section][sample]
        )
        t = 0.5 * (inner + outer) + offset[sample]
        slope = slope + offset_slope[sample]
        along = 1.0 - curvature[sample] * t
        forward = np.array([entry.forward for entry in entries], bool)[lane]
        tilt, _ = self.superelevation(road[sample], s[sample])
        height, _ = self.elevation(road[sample], s[sample])
        xy = np.stack([x[sample] - t * np.sin(heading[sample]), y[sample] + t * np.cos(heading[sample])], 1)
        yaw = heading[sample] + np.arctan2(slope, np.maximum(along, 1e-3)) + np.where(forward, 0.0, np.pi)
        # Samples follow the traffic: those of a lane that runs against its road are turned round.
        order = np.where(forward, np.arange(first[-1]), first[lane] + first[lane + 1] - 1 - np.arange(first[-1]))
        folded = np.zeros(len(keys), bool)
        folded[lane[(along < 0.0) & (np.abs(outer - inner) > 0.1)]] = True
        return LaneSamples(
            first,
            s[sample][order],
            xy[order],
            (height + t * np.tan(np.clip(tilt, -1.0, 1.0)))[order],
            yaw[order],
            (heading[sample] + slope)[order],
            np.abs(outer - inner)[order],
            folded,
        )

    def _boundaries(  # noqa: PLR0917
        self, keys: Sequence[Key], lane_section: Index, entries: Sequence[Lane], first: Index, lane: Index, s: F64
    ) -> tuple[F64, F64, F64]:
        """Return inner and outer edge of each sample, from the lane offset, and the slope of the lane's centre."""
        widths = Cubics([entry.widths for entry in entries])
        borders = Cubics([entry.borders for entry in entries])
        width, width_slope = widths(lane, s)
        border, border_slope = borders(lane, s)
        has_border = borders.count[lane] > 0
        sign = np.sign([key[2] for key in keys])[lane]
        # Lanes next to the centre come first, then those beside them.
        inner_lane = np.full(len(keys), -1)
        rank = np.zeros(len(keys), np.int64)
        order = sorted(range(len(keys)), key=lambda row: (lane_section[row], keys[row][2] > 0, abs(keys[row][2])))
        for row, before in zip(order[1:], order[:-1], strict=True):
            if lane_section[row] == lane_section[before] and keys[row][2] * keys[before][2] > 0:
                inner_lane[row], rank[row] = before, rank[before] + 1
        inner, inner_slope, outer, outer_slope = np.zeros((4, len(lane)))
        by_rank = np.argsort(rank[lane], kind="stable")
        rank_ends = np.searchsorted(rank[lane][by_rank], np.arange(int(rank.max(initial=0)) + 2))
        for low, high in zip(rank_ends[:-1].tolist(), rank_ends[1:].tolist(), strict=True):
            rows = by_rank[low:high]
            lanes = lane[rows]
            has_inner = inner_lane[lanes] >= 0
            beside = np.where(has_inner, rows - first[lanes] + first[np.maximum(inner_lane[lanes], 0)], 0)
            inner[rows] = np.where(has_inner, outer[beside], 0.0)
            inner_slope[rows] = np.where(has_inner, outer_slope[beside], 0.0)
            by_width = inner[rows] + sign[rows] * np.maximum(width[rows], 0.0)
            outer[rows] = np.where(has_border[rows], border[rows], by_width)
            outer_slope[rows] = np.where(
                has_border[rows], border_slope[rows], inner_slope[rows] + sign[rows] * width_slope[rows]
            )
        return inner, outer, 0.5 * (inner_slope + outer_slope)

    def places(self, placements: Sequence[Placement]) -> F64:
        """Return x, y and heading of placements [n, 3]."""
        rows = np.array([self.row[place.road] for place in placements], np.int64)
        table = np.array([(place.s, place.t, place.heading) for place in placements], np.float64).reshape(-1, 3)
        x, y, heading = self.at(rows, table[:, 0], table[:, 1])
        inertial = np.array([place.inertial for place in placements], bool)
        x, y = np.where(inertial, table[:, 0], x), np.where(inertial, table[:, 1], y)
        return np.stack([x, y, table[:, 2] + np.where(inertial, 0.0, heading)], 1)

    def crosswalks(self) -> list[F64]:
        """Return the corners [., 2] of each crosswalk."""
        outlines: list[Outline] = [outline for road in self.network.roads.values() for outline in road.crosswalks]
        poses = self.places([outline.place for outline in outlines])
        result = []
        for outline, (x, y, heading) in zip(outlines, poses, strict=True):
            corners = np.array(outline.corners, np.float64)
            if outline.on_road:
                rows = np.full(len(corners), self.row[outline.place.road])
                result.append(np.stack(self.at(rows, corners[:, 0], corners[:, 1])[:2], 1))
                continue
            cosine, sine = np.cos(heading), np.sin(heading)
            result.append(corners @ np.array([[cosine, sine], [-sine, cosine]]) + [x, y])
        return result
