"""A leader arm that drives a follower arm in another process."""

from __future__ import annotations

import tempfile
from pathlib import Path

from fixtures.arm_pair import ArmPair, Led
from fixtures.network_lab import NetworkLab, Weather, missing

from benchmarks.table import Row

SECONDS, SECONDS_QUICK = 600.0, 10.0
NETWORK_SECONDS = 60.0
DELAY_S = 0.05
BOUND_MS = 12.0
HZ = 50.0
RATE_SHARE = 0.98


def leading(*, quick: bool) -> list[Row]:
    """Measure over Zenoh on one machine, and over a network of 50 ms one way."""
    return [
        on_one_machine(SECONDS_QUICK if quick else SECONDS),
        over_network(SECONDS_QUICK if quick else NETWORK_SECONDS),
    ]


def on_one_machine(seconds: float) -> Row:
    with tempfile.TemporaryDirectory(prefix="bench-pair-") as folder, ArmPair(Path(folder)) as pair:
        return _row("on one machine", seconds, pair.lead(seconds, HZ), 0.0)


def over_network(seconds: float) -> Row:
    where = f"with {DELAY_S * 1000:g} ms of network delay, mutual TLS"
    if why := missing():
        return Row(f"leader to follower's bus {where}", f"not measured: {why}", "", None, "", ok=True)
    with (
        NetworkLab() as lab,
        tempfile.TemporaryDirectory(prefix="bench-pair-") as folder,
        ArmPair(Path(folder), lab) as pair,
    ):
        lab.weather = Weather(delay_s=DELAY_S)
        row = _row(where, seconds, pair.lead(seconds, HZ), DELAY_S * 1000)
        # The processes leave by messages, which need a network.
        lab.weather = Weather()
        return row


def _row(where: str, seconds: float, led: Led, delay_ms: float) -> Row:
    took = sorted(led.took_ms) or [float("inf")]
    p50, p99 = (took[int(len(took) * share)] for share in (0.5, 0.99))
    bound = delay_ms + BOUND_MS
    return Row(
        what=f"leader's arm read to the write at the follower's servo, {where}, {HZ:g} Hz for {seconds:g} s",
        ours=f"p50 {p50:.2f} p99 {p99:.2f} max {took[-1]:.2f} ms; {led.lost} of {led.sent} lost",
        against="",
        ratio=None,
        must=f"p99 at most {bound:g} ms, none lost, {RATE_SHARE * HZ:g} frames a second or more",
        ok=p99 <= bound
        and led.lost == 0
        and led.publisher["frames"] == led.sent
        and led.sent >= RATE_SHARE * HZ * seconds,
    )
