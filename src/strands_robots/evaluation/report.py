"""Report of an evaluation: a table and a plot of success rates."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import median
from xml.sax.saxutils import escape

from strands_robots.evaluation.episode import Episode
from strands_robots.evaluation.statistics import wilson

Outcomes = Mapping[str, Sequence[Episode]]
"""Episodes by policy."""

HEADINGS = ("policy", "episodes", "success", "95 % interval", "median time of a success")

_ROW, _LEFT, _WIDTH, _TOP = 34, 190, 420, 54
"""Pixels of the plot."""


def rows_of(outcomes: Outcomes) -> list[tuple[str, ...]]:
    """Return a row for each policy, as :data:`HEADINGS` name its columns."""
    rows: list[tuple[str, ...]] = []
    for policy, episodes in outcomes.items():
        good = [each for each in episodes if each.success]
        low, high = wilson(len(good), len(episodes))
        took = f"{median(each.seconds for each in good):.1f} s" if good else "-"
        share = f"{100 * len(good) / max(1, len(episodes)):.0f} %"
        rows.append((policy, str(len(episodes)), share, f"{100 * low:.0f} to {100 * high:.0f} %", took))
    return rows


def table_of(outcomes: Outcomes) -> str:
    """Return the rows as a Markdown table."""
    lines = [HEADINGS, tuple("---" for _ in HEADINGS), *rows_of(outcomes)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def write_plot(path: Path, title: str, outcomes: Outcomes) -> None:
    """Draw the success rate of each policy with its interval, as SVG."""
    height = _TOP + _ROW * len(outcomes) + 40
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{_LEFT + _WIDTH + 60}" height="{height}" '
        'font-family="sans-serif" font-size="13">',
        f'<rect width="100%" height="100%" fill="white"/><text x="16" y="26" font-size="16">{escape(title)}</text>',
    ]
    for percent in range(0, 101, 25):
        x = _LEFT + _WIDTH * percent / 100
        parts.append(f'<path d="M{x} {_TOP - 8}V{height - 34}" stroke="#dddddd"/>')
        parts.append(f'<text x="{x}" y="{height - 16}" text-anchor="middle">{percent} %</text>')
    for index, (policy, episodes) in enumerate(outcomes.items()):
        good = sum(each.success for each in episodes)
        low, high = (_LEFT + _WIDTH * each for each in wilson(good, len(episodes)))
        y, x = _TOP + _ROW * index + 10, _LEFT + _WIDTH * good / max(1, len(episodes))
        parts.append(f'<text x="16" y="{y + 5}">{escape(policy)}</text>')
        parts.append(f'<path d="M{low:.1f} {y}H{high:.1f}" stroke="#1f5a94" stroke-width="3"/>')
        parts.append(f'<circle cx="{x:.1f}" cy="{y}" r="6" fill="#1f5a94"/>')
    path.write_text("\n".join([*parts, "</svg>", ""]), encoding="utf-8")
