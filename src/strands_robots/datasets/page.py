"""Page of a dataset: one HTML file without script, network or other files.

Each drawn episode has its plots of state and action, its pictures, where it was stopped, and who acted.
"""

from __future__ import annotations

import base64
import io
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from strands_robots.datasets import tables
from strands_robots.datasets.check import DatasetFinding, check_dataset
from strands_robots.datasets.episodes import POLICY
from strands_robots.datasets.layout import DatasetError, DatasetInfo, data_file, episodes_file, video_file
from strands_robots.datasets.recorded import (
    ACTION,
    ACTOR,
    ACTORS,
    AGE,
    EMERGENCY,
    INTERVENTION,
    STATE,
    STOP,
    STOPPED,
    SUCCESS,
)
from strands_robots.datasets.video import pictures_of
from strands_robots.utils import ValidationError, optional_module, whole

DRAWN_MAX = 50
"""Most episodes that are drawn; all are listed."""

LISTED_MAX = 1000
"""Most episodes that are listed."""

FOUND_MAX = 100
"""Most findings of the check that are listed."""

POINTS_MAX = 240
"""Most points of a plot."""

PICTURES_MAX = 8
"""Most pictures of one camera in one episode."""

PICTURE_WIDTH = 160

_WIDTH, _HEIGHT, _BAND = 320, 84, 8

STOPS = {STOPPED: "stopped", EMERGENCY: "emergency stop", 3: "refused while locked"}
"""Values of the feature ``stop`` in words."""

_STYLE = """
:root{color-scheme:light dark;--back:#fff;--text:#1b1f24;--soft:#5b6470;--line:#d5dae0;--state:#0b63c4;--action:#b3541e;
--stop:#c01c28;--led:#7a3ea855;--by1:#2d7a46;--by2:#7a3ea8;--by3:#a8780c;--by4:#0e7f8c}
@media(prefers-color-scheme:dark){:root{--back:#14171b;--text:#e6e9ed;--soft:#9aa4b0;--line:#343b44;--state:#6cb1ff;
--action:#f0a070;--stop:#ff6b74;--led:#b78ae655;
--by1:#63c384;--by2:#b78ae6;--by3:#e0b44c;--by4:#57c7d4}}
body{margin:0 auto;max-width:72rem;padding:1rem;background:var(--back);color:var(--text);
font:15px/1.45 system-ui,sans-serif}
h1{font-size:1.3rem}p,li{color:var(--soft)}
.wide{overflow-x:auto}table{border-collapse:collapse;width:100%}th,td{text-align:left;padding:.25rem .6rem;
border-bottom:1px solid var(--line);font-variant-numeric:tabular-nums;vertical-align:top}
.plots{display:grid;grid-template-columns:repeat(auto-fill,minmax(15rem,1fr));gap:.8rem}
figure{margin:0}.plots~figure{margin-top:1rem}figcaption{color:var(--soft);font-size:.85rem;overflow-wrap:anywhere}
svg{width:100%;height:auto;border:1px solid var(--line);border-radius:4px;display:block}
.strip{display:flex;flex-wrap:wrap;gap:.4rem}.strip img{border-radius:4px;max-width:10rem;display:block}
.state{stroke:var(--state)}.action{stroke:var(--action);stroke-dasharray:4 3}.stopped{stroke:var(--stop)}
.led{fill:var(--led)}polyline{fill:none;stroke-width:1.6;vector-effect:non-scaling-stroke}
.by0{color:var(--line)}.by1{color:var(--by1)}.by2{color:var(--by2)}.by3{color:var(--by3)}.by4{color:var(--by4)}
rect[class^=by]{fill:currentColor}
.wrong,.stop{color:var(--stop);font-weight:600}summary{cursor:pointer;padding:.3rem 0}
"""


@dataclass(frozen=True, slots=True)
class _Episode:
    """An episode as it was read; ``frames`` are empty where that failed."""

    number: int
    row: Mapping[str, Any]
    frames: Mapping[str, NDArray[Any]]

    @property
    def task(self) -> str:
        tasks = self.row.get("tasks")
        return ", ".join(map(str, tasks)) if isinstance(tasks, Sequence) and not isinstance(tasks, str) else str(tasks)

    @property
    def policy(self) -> str:
        return str(self.row.get(POLICY) or "")

    @property
    def count(self) -> int:
        return len(self.frames.get("frame_index", ()))

    def column(self, name: str) -> NDArray[Any]:
        return np.asarray(self.frames.get(name, np.zeros(0)))


def dataset_page(folder: Path, episodes: Sequence[int] | None = None) -> str:
    """Return the page of a dataset as HTML.

    Args:
        folder: of the dataset.
        episodes: those to draw, at most :data:`DRAWN_MAX`; by default the first ones.

    Raises:
        ValidationError: an episode that the dataset does not have, or too many.
        DatasetError: the dataset has no index that can be read.
        MissingExtraError: the [dataset] extra is not installed.
    """
    info, found = check_dataset(folder)
    drawn = _chosen(info, episodes)
    listed = [_read(folder, number) for number in range(min(info.episodes, LISTED_MAX))]
    read = [listed[number] if number < len(listed) else _read(folder, number) for number in drawn]
    facts = f"Episodes: {info.episodes}, frames: {info.frames} at {info.fps} a second. Robot: {info.robot_type}."
    parts = [
        f"<h1>{escape(folder.name)}</h1><p>{escape(facts)}</p>",
        *_findings(found),
        *_list(info, listed),
        *(part for each in read for part in _drawn(folder, info, each)),
    ]
    policy = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        f'<meta http-equiv="Content-Security-Policy" content="{policy}">'
        '<meta name="viewport" content="width=device-width,initial-scale=1">'
        f"<title>{escape(folder.name)}</title><style>{_STYLE}</style></head><body>{''.join(parts)}</body></html>\n"
    )


def _chosen(info: DatasetInfo, episodes: Sequence[int] | None) -> list[int]:
    if episodes is None:
        return list(range(min(info.episodes, DRAWN_MAX)))
    if len(episodes) > DRAWN_MAX:
        raise ValidationError(f"episodes must be at most {DRAWN_MAX}, not {len(episodes)}.")
    if not info.episodes:
        raise ValidationError("episodes must be none: the dataset has no episode.")
    return [whole("episode", each, low=0, high=info.episodes - 1) for each in episodes]


def _read(folder: Path, number: int) -> _Episode:
    try:
        row = tables.read_row(folder / episodes_file(number))
        return _Episode(number, row, tables.read_frames(folder / data_file(number)))
    except DatasetError:
        # The check has named it.
        return _Episode(number, {"tasks": "cannot be read"}, {})


def _findings(found: Sequence[DatasetFinding]) -> Iterator[str]:
    if not found:
        yield "<p>The check found nothing.</p>"
        return
    yield f"<details open><summary>The check found {len(found)} things.</summary><ul>"
    for each in found[:FOUND_MAX]:
        kind = '<span class="wrong">wrong</span>' if each.wrong else "look"
        yield f"<li>{kind} {escape(each.where)}: {escape(each.said)}</li>"
    yield f"<li>and {len(found) - FOUND_MAX} more.</li></ul></details>" if len(found) > FOUND_MAX else "</ul></details>"


def _list(info: DatasetInfo, episodes: Sequence[_Episode]) -> Iterator[str]:
    yield '<div class="wide"><table><thead><tr><th>Episode</th><th>Task</th><th>Policy</th><th>Seconds</th>'
    yield "<th>Success</th><th>Stops</th><th>Led by a person</th><th>Oldest state, ms</th></tr></thead><tbody>"
    for each in episodes:
        ages = each.column(f"{AGE}state")
        cells = (
            str(each.number),
            each.task,
            each.policy,
            f"{each.count / info.fps:.1f}",
            ("yes" if each.column(SUCCESS).any() else "no") if SUCCESS in each.frames else "",
            ", ".join(STOPS.get(code, str(code)) for code in _stops(each).values()),
            f"{100 * each.column(INTERVENTION).mean():.0f} %" if each.column(INTERVENTION).any() else "",
            f"{ages.max():.0f}" if len(ages) else "",
        )
        stop = ' class="stop"' if cells[5] else ""
        yield "<tr>" + "".join(
            f"<td{stop if index == 5 else ''}>{escape(cell)}</td>" for index, cell in enumerate(cells)
        )
        yield "</tr>"
    yield "</tbody></table></div>"
    if info.episodes > len(episodes):
        yield f"<p>The first {len(episodes)} of {info.episodes} episodes are listed.</p>"


def _drawn(folder: Path, info: DatasetInfo, episode: _Episode) -> Iterator[str]:
    if not episode.count:
        return
    title = f"Episode {episode.number}: {episode.task}, {episode.count / info.fps:.1f} s"
    yield f"<details{' open' if episode.number == 0 else ''}><summary><strong>{escape(title)}</strong></summary>"
    legend = ", ".join(f'<span class="by{code}">&#9632;</span>&nbsp;{ACTORS[code]}' for code in _acting(episode))
    band = f" Band below: who acted ({legend})." if legend else ""
    yield f"<p>Line: state. Dashed: action. Red: a stop. Shaded: led by a person.{band}</p>"
    yield '<div class="plots">'
    for name in info.features[STATE].names if STATE in info.features else ():
        state, action = (_joint(info, episode, key, name) for key in (STATE, ACTION))
        yield _plot(name, state, action, episode)
    yield "</div>"
    for key in info.videos:
        yield _strip(folder / video_file(key, episode.number), key, episode.count)
    yield "</details>"


def _joint(info: DatasetInfo, episode: _Episode, key: str, name: str) -> NDArray[np.float64]:
    names = info.features[key].names if key in info.features else ()
    if name not in names:
        return np.zeros(0)
    values = np.asarray(episode.column(key), dtype=np.float64)
    return values if values.ndim == 1 else values[:, names.index(name)]


def _stops(episode: _Episode) -> dict[int, int]:
    column = episode.column(STOP)
    return {int(at): int(column[at]) for at in np.flatnonzero(column)[:FOUND_MAX]}


def _acting(episode: _Episode) -> list[int]:
    """Return the codes of those who acted; none of a dataset that does not tell."""
    column = episode.column(ACTOR)
    return [code for code in range(len(ACTORS)) if column.ndim == 1 and (column == code).any()]


def _plot(name: str, state: NDArray[np.float64], action: NDArray[np.float64], episode: _Episode) -> str:
    lines = [values for values in (state, action) if len(values)]
    low, high = min(values.min() for values in lines), max(values.max() for values in lines)
    span, last = (high - low) or 1.0, max(episode.count - 1, 1)

    def x(frame: float) -> str:
        return f"{_WIDTH * frame / last:.1f}"

    def line(values: NDArray[np.float64], kind: str) -> str:
        if not len(values):
            return ""
        frames = np.unique(np.linspace(0, len(values) - 1, min(len(values), POINTS_MAX)).astype(int))
        points = " ".join(f"{x(at)},{_HEIGHT - 4 - (_HEIGHT - 8) * (values[at] - low) / span:.1f}" for at in frames)
        return f'<polyline class="{kind}" points="{points}"/>'

    led = "".join(
        f'<rect class="led" x="{x(begin)}" y="0" width="{_WIDTH * (end - begin) / last:.1f}" height="{_HEIGHT}"/>'
        for begin, end in _spans(episode.column(INTERVENTION))
    )
    acted = "".join(
        f'<rect class="by{code}" x="{x(begin)}" y="{_HEIGHT + 2}" width="{_WIDTH * (end - begin) / last:.1f}" '
        f'height="{_BAND}"><title>{ACTORS[code]}</title></rect>'
        for code in _acting(episode)
        for begin, end in _spans(episode.column(ACTOR) == code)
    )
    height = _HEIGHT + 2 + _BAND if acted else _HEIGHT
    stops = "".join(
        f'<polyline class="stopped" points="{x(at)},0 {x(at)},{_HEIGHT}"><title>{escape(STOPS.get(code, ""))}</title>'
        "</polyline>"
        for at, code in _stops(episode).items()
    )
    shown = f"{name}: {low:.4g} to {high:.4g}"
    return (
        f'<figure><svg viewBox="0 0 {_WIDTH} {height}" role="img" aria-label="{escape(shown)}">{led}{acted}'
        f"{line(state, 'state')}{line(action, 'action')}{stops}</svg><figcaption>{escape(shown)}</figcaption></figure>"
    )


def _spans(column: NDArray[Any]) -> Iterator[tuple[int, int]]:
    """Yield the first frame of each stretch that is true, and the one after it."""
    edges = np.flatnonzero(np.diff(np.concatenate(([0], column.astype(np.int8), [0]))))
    yield from islice(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True), FOUND_MAX)


def _strip(path: Path, key: str, count: int) -> str:
    """Return some pictures of a video, evenly spaced."""
    image = optional_module("PIL.Image", what="A page with pictures", extra="dataset")
    wanted = set(np.linspace(0, max(count - 1, 0), PICTURES_MAX).astype(int).tolist())
    pictures = []
    try:
        for index, pixels in enumerate(islice(pictures_of(path), count)):
            if index in wanted:
                small = image.fromarray(pixels)
                small.thumbnail((PICTURE_WIDTH, PICTURE_WIDTH))
                buffer = io.BytesIO()
                small.save(buffer, format="JPEG", quality=70)
                data = base64.b64encode(buffer.getvalue()).decode("ascii")
                pictures.append(f'<img alt="frame {index}" src="data:image/jpeg;base64,{data}">')
    except DatasetError as cut:
        pictures.append(f"<p>{escape(str(cut))}</p>")
    return f'<figure><figcaption>{escape(key)}</figcaption><div class="strip">{"".join(pictures)}</div></figure>'
