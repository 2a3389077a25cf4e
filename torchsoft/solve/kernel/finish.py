"""What an accepted stage leaves: the rates of the whole state, powers, moments, and what acts on the bodies."""

from typing import Any

import numpy as np

from torchsoft.codegen.invoke import call_value
from torchsoft.solve.kernel import compiled
from torchsoft.solve.kernel.arrays import Array
from torchsoft.solve.kernel.inertia import base_velocity, inertia_force, solve, stiffness_force
from torchsoft.solve.kernel.linear import put, row_of

NEGLIGIBLE_RATE = 1e-16
"""Change of a nodal force in a stage [N] that counts as none."""


@compiled
def finish(s: Any, w: Any, y: Array, a: float, powers: Array, moments: Array) -> float:
    """All rates of the accepted stage in w.k, what the pads and contacts dissipate in `powers` (pads, dashpots, slip) [W], the
    contacts' generalised forces in w.load, the pads' moments (Eq. 35) [N.m]. Returns a bound of every surface speed [m/s]."""
    p, k = s.p, w.k
    count, fastest = s.pad_base.size, 0.0
    powers[: count + 2] = 0.0
    w.load[:] = 0.0
    out = w.decay
    for pad in range(count):
        at, c = s.contact_point_start[s.pad_contact_start[pad]], s.pad_contact_start[pad]
        first, last, start = s.pad_node_start[pad], s.pad_node_start[pad + 1], s.pad_y_start[pad]
        moments[pad] = 0.0
        for i in range(w.actives[pad]):
            n = w.active[at + i]
            while n >= s.contact_point_start[c + 1]:
                c += 1
            fx, fy = w.out[n, 0], w.out[n, 1]
            moments[pad] += s.point_X[n, 0] * fy - s.point_X[n, 1] * fx
            frame, x, body, base = w.frame[c], w.x[n], s.contact_body[c], s.pad_base[pad]
            X, Y = frame[0] * fx - frame[1] * fy, frame[1] * fx + frame[0] * fy
            w.load[body] -= X
            w.load[body + 1] -= Y
            w.load[body + 2] -= x[3] * fy - x[4] * fx
            w.load[base] += X
            w.load[base + 1] += Y
            w.load[base + 2] += (x[3] + frame[2]) * fy - (x[4] + frame[3]) * fx
            powers[count] += w.out[n, 5]
            powers[count + 1] += w.out[n, 6]
        i = 0
        for c in range(s.pad_contact_start[pad], s.pad_contact_start[pad + 1]):
            own = p[s.contact_p_start[c] : s.contact_p_start[c + 1]]
            for n in range(s.contact_point_start[c], s.contact_point_start[c + 1]):
                j = s.point_y_start + n
                if i < w.actives[pad] and w.active[at + i] == n:
                    k[j] = w.out[n, 2]
                    i += 1
                elif y[j] != 0.0:  # away from contact the stretch decays through the slip element
                    w.x[n, 6], w.x[n, 7], w.x[n, 8] = y[j], s.point_weight[n], a
                    call_value(s.contact_free[c], w.x[n, 6:], own, out)
                    k[j] = out[0]
                    powers[count] += out[1]
                    powers[count + 1] += out[2]
                else:
                    k[j] = 0.0
        if s.pad_v_start[pad] >= 0:
            fastest = max(fastest, finish_inertial(s, w, pad, y, a, powers, moments))
            continue
        chain, branches, size = s.pad_chain_at[pad], s.pad_branches[pad], 2 * (last - first)
        F, total = w.F_linear.reshape(w.F_linear.size), 0.0
        for b in range(branches):
            J, tau, z = p[chain + b], p[chain + branches + b], start + b * size
            low, high = size, 0
            for m in range(size):
                loaded = 2 * w.low[pad] <= 2 * first + m < 2 * w.high[pad]
                rate = ((F[2 * first + m] if loaded else 0.0) - y[z + m]) / (tau + a)
                k[z + m] = rate
                if abs(rate) * a > NEGLIGIBLE_RATE:
                    low, high = min(low, m), m + 1
                    total += J * abs(rate)
            power, changes = 0.0, k[z + low : z + high]
            for m in range(changes.size):
                row, u = row_of(s.pad_C, s.pad_C_start[pad], low + m, size)[low:high], 0.0
                for other in range(row.size):
                    u += row[other] * changes[other]
                power += changes[m] * u
            powers[pad] += J * tau * power
        fastest = max(fastest, total * s.pad_reach[pad])
    for i in range(s.body_coordinate.size):
        c = s.body_coordinate[i]
        k[s.body_q_start + i] = w.V[c]
        k[s.body_V_start + i] = (w.V[c] - y[s.body_V_start + i]) / a
    bound = 0.0
    for c in range(s.contact_pad.size):
        f, C_ = w.frame[c], s.contact_body[c]
        arm = abs(f[2]) + abs(f[3]) + s.contact_size[c]
        speed = np.hypot(f[4], f[5]) + abs(w.V[C_ + 2]) * s.contact_size[c] + abs(f[6]) * arm
        bound = max(bound, speed)
    return bound + fastest


@compiled
def finish_inertial(s: Any, w: Any, pad: int, y: Array, a: float, powers: Array, moments: Array) -> float:
    """Rates of an inertial pad, its part in powers, load and moment; returns its largest nodal rate [m/s]."""
    p = s.p
    first, last = s.inertia_dof_start[pad], s.inertia_dof_start[pad + 1]
    base, at = s.pad_base[pad], s.inertia_material_at[pad]
    vx, vy = base_velocity(s, pad, w.V, w.q)
    extra, effort, forces, stiffness = (
        w.inertial[0, first:last], w.inertial[1, first:last], w.inertial[2, first:last], w.inertial[3, first:last]
    )  # fmt: skip
    extra[:] = 0.0
    for node in range(w.low[pad], w.high[pad]):
        for r in range(2):
            extra[s.inertia_surface[2 * node + r]] = w.F_linear[node, r]
    put(extra, forces)
    for i in range(last - first):
        extra[i] -= p[at + 3] * s.inertia_area[first + i] / a * (vx if i % 2 == 0 else vy)
    solve(s, pad, extra)
    fastest = 0.0
    rates = w.full[first:last]
    for i in range(last - first):
        rates[i] += extra[i]
        w.k[s.pad_y_start[pad] + i] = rates[i]
        speed = rates[i] + (vx if i % 2 == 0 else vy)
        w.k[s.pad_v_start[pad] + i] = (speed - y[s.pad_v_start[pad] + i]) / a
        fastest = max(fastest, abs(rates[i]))
    stiffness_force(s, pad, rates, stiffness)
    for i in range(0, last - first):
        powers[pad] += p[at + 2] * rates[i] * stiffness[i]
        effort[i] = forces[i] - p[at + 3] * s.inertia_area[first + i] * w.k[s.pad_v_start[pad] + i]
    moments[pad] = 0.0
    for i in range(0, last - first, 2):
        moments[pad] += s.inertia_X[first + i] * effort[i + 1] - s.inertia_X[first + i + 1] * effort[i]
    mx, my = inertia_force(s, w, pad, y, a, rates)
    cos, sin = np.cos(w.q[base + 2]), np.sin(w.q[base + 2])
    w.load[base] -= cos * mx - sin * my
    w.load[base + 1] -= sin * mx + cos * my
    return fastest * 1.5
