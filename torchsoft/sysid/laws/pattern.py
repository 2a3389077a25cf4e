"""Where in the motion one law fails and another does not: by channel, by phase, and the interval that tells most.

Phases are those of any rig, the first that is true: some contact is apart; contacts slip; normal forces change, as in
a grasp or a press (loading); bodies move (rolling); nothing moves (hold).
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import torch

from torchsoft.solve.simulate import simulate
from torchsoft.sysid.answer.comparison import Share, Where
from torchsoft.sysid.laws.evidence import Density
from torchsoft.sysid.problem.prediction import choice, prepared
from torchsoft.sysid.problem.problem import Problem
from torchsoft.sysid.problem.recording import Array

SLIPS = 1e-3
"""Speed [m/s] of slip, weighted by friction forces, above which contacts count as slipping."""

LOADS = 1.0
"""Rate [1/s] of the normal forces' sum, over the largest sum, above which they count as changing."""

MOVES = 1e-3
"""Speed [m/s] of a body above which it counts as moving."""

MOST = 0.5
"""Part of a recording's evidence that its most telling interval has."""


class Motion(NamedTuple):
    """What moves at the times t (k,) [s]: speed of slip [m/s], acceleration of the fastest body [m/s2] (k,), and phases."""

    t: Array
    slip: Array
    acceleration: Array
    phase: list[str]

    @property
    def pieces(self) -> list[tuple[float, float, str]]:
        """Start [s], end [s] and phase of every piece in which the phase does not change."""
        starts = [0, *(i for i in range(1, len(self.t)) if self.phase[i] != self.phase[i - 1])]
        ends = [*(self.t[i] for i in starts[1:]), self.t[-1]]
        return [(float(self.t[i]), float(end), self.phase[i]) for i, end in zip(starts, ends)]


@torch.no_grad()
def motion(problem: Problem, x: Array, k: int, rtol: float) -> Motion:
    """Of recording number k at x (n,). Raises `SimulationFailed`."""
    recording = problem.recordings[k]
    begun, grid = recording.begin(), recording.grid(False)
    run = simulate(begun.rig, grid.t, y0=prepared(begun, problem.values(x, k), ()).y0, **choice(rtol))
    t, rows = grid.t.numpy(), slice(grid.early, None)
    N = torch.stack([force[..., 0].sum(-1) for force in run.force.values()]).numpy()  # (contacts, k)
    T = torch.stack([force[..., 1].abs().sum(-1) for force in run.force.values()]).sum(0).numpy()
    slip = np.gradient(run.dissipated["slip"].numpy(), t) / np.maximum(T, 1e-9 * max(float(T.max()), 1e-300))
    total = N.sum(0)
    loads = np.abs(np.gradient(total, t)) / max(float(total.max()), 1e-300)
    velocity = torch.stack([v[:, :2] for v in run.state.velocity.values()]).numpy()  # (bodies, k, 2)
    speed = np.linalg.norm(velocity, axis=-1).max(0)
    acceleration = np.linalg.norm(np.gradient(velocity, t, axis=1), axis=-1).max(0)
    apart = N.min(0) <= 1e-6 * max(float(total.max()), 1e-300)
    cases = {"apart": apart, "slip": slip > SLIPS, "loading": loads > LOADS, "rolling": speed > MOVES}
    phase = np.select(list(cases.values()), list(cases), "hold")
    return Motion(t[rows], slip[rows], acceleration[rows], phase[rows].tolist())


class Telling(NamedTuple):
    """Samples of one channel at t (k,) [s]: evidence [nats] (k,), and by how much the predictions part before each (k,)."""

    t: Array
    evidence: Array
    parting: Array


def telling(pairs: Sequence[tuple[Density, Density]]) -> dict[tuple[str, str], Telling]:
    """By recording and channel. A sample's evidence is half the difference of the squared whitened residuals."""
    out = {}
    for a, b in pairs:
        for mine, its in zip(a.parts, b.parts):
            evidence = 0.5 * (b.r * b.s)[its.rows] - 0.5 * (a.r * a.s)[mine.rows]
            apart = b.r[its.rows] - a.r[mine.rows]
            out[mine.recording, mine.channel] = Telling(mine.t, evidence, np.abs(np.diff(apart, prepend=apart[0])))
    return out


def where(other: str, pairs: Sequence[tuple[Density, Density]], motions: Mapping[str, Motion]) -> Where | None:
    """Where the evidence against the second of two laws stands, in pairs of their densities; None where there is none."""
    told = telling(pairs)
    total = sum(float(one.evidence.sum()) for one in told.values())
    if total <= 0:
        return None
    channels, by_recording = dict[str, float](), dict[str, float]()
    for (recording, channel), one in told.items():
        for shares, key in ((channels, channel), (by_recording, recording)):
            shares[key] = shares.get(key, 0.0) + float(one.evidence.sum()) / total
    recording = max(by_recording, key=by_recording.__getitem__)
    mine = {channel: one for (name, channel), one in told.items() if name == recording}
    phases, interval = shares_of_phases(told, motions), shortest([(one.t, one.evidence) for one in mine.values()])
    said = sentence(other, recording, interval, total, mine, motions[recording], phases)
    return Where(channels, phases, recording, interval, said)


def shares_of_phases(told: Mapping[tuple[str, str], Telling], motions: Mapping[str, Motion]) -> dict[str, Share]:
    """Of all recordings together."""
    sums: dict[str, Array] = {}
    for one in motions.values():
        for start, end, name in one.pieces:
            sums[name] = sums.get(name, np.zeros(3)) + (end - start, 0.0, 0.0)
    for (recording, _), one in told.items():
        phase, near = motions[recording].phase, nearest(motions[recording].t, one.t)
        names = np.array([phase[i] for i in near])
        for name in sums:
            here = names == name
            sums[name] = sums[name] + (0.0, one.evidence[here].sum(), one.parting[here].sum())
    whole = sum(sums.values())
    return {name: Share(*map(float, some / np.where(whole > 0, whole, 1.0))) for name, some in sums.items()}


def nearest(t: Array, at: Array) -> Array:
    """Indices (k,) of the times t that are nearest to others (k,)."""
    i = np.clip(np.searchsorted(t, at), 1, len(t) - 1)
    return np.where(at - t[i - 1] < t[i] - at, i - 1, i)


def shortest(series: Sequence[tuple[Array, Array]]) -> tuple[float, float]:
    """The shortest interval [s] with at least `MOST` of the evidence in some series (times, evidence) of one recording."""
    t = np.concatenate([one for one, _ in series])
    order = np.argsort(t, kind="stable")
    sums = np.concatenate(([0.0], np.cumsum(np.concatenate([e for _, e in series])[order])))
    t, best = t[order], (0, len(order) - 1)
    for i in range(len(t)):
        enough = sums[i + 1 :] - sums[i] >= MOST * sums[-1]
        j = i + int(enough.argmax())
        if enough.any() and t[j] - t[i] < t[best[1]] - t[best[0]]:
            best = i, j
    return float(t[best[0]]), float(t[best[1]])


DOING = {
    "apart": "while a contact is apart", "slip": "where contacts slip", "loading": "where normal forces change",
    "rolling": "in rolling without slip", "hold": "at rest",
}  # fmt: skip


def sentence(
    other: str, recording: str, interval: tuple[float, float], total: float, series: Mapping[str, Telling], motion: Motion,
    phases: Mapping[str, Share],
) -> str:  # fmt: skip
    """What a reader wants to know of it."""
    start, end = interval
    now = (motion.t >= start) & (motion.t <= end)
    inside = {c: float(one.evidence[(one.t >= start) & (one.t <= end)].sum()) for c, one in series.items()}
    channel, share = max(inside, key=inside.__getitem__), sum(inside.values())
    parts = max(phases, key=lambda name: phases[name].parting)
    part, most = phases[parts], (end - start) / (motion.t[-1] - motion.t[0])
    return (
        f"the predictions part {DOING[parts]}, by {part.parting:.0%} of the way in {part.time:.0%} of the time; `{other}` is "
        f"off most from {start:.4g} to {end:.4g} s of `{recording}`, at slip of up to {motion.slip[now].max():.2g} m/s and "
        f"accelerations of up to {motion.acceleration[now].max():.2g} m/s2: {share / total:.0%} of the evidence stands "
        f"there, in {most:.0%} of the recording's time, {inside[channel] / share:.0%} of it in {channel}"
    )
