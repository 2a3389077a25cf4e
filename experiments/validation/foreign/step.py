"""Backward Euler of the whole rig: the end of every step solves one dense system for the velocities
of the disc, the bracket and the nodes near the disc, by Newton's method with differences for
derivatives. Compiled, since 50 000 steps make a second."""

import numpy as np
from numba import njit

MARGIN = 30e-6
"""Nodes as near to the disc as this [m] may touch it by the end of the step."""

DIFFERENCE, SOLVED, MOST, SHORTEST = 1e-9, 1e-9, 100, 1e-3
"""Change of a speed that derivatives are taken by, the last change of Newton's [m/s], its
iterations, and its shortest part."""

CREEP, TAKEN_IN = 1e-5, 1e-6
"""Speed [m/s] below which the literal law's friction does not have its whole size, and depth [m]
over which it, and adhesion, are taken in at touch-down: jumps cannot be solved for."""

AT_ONCE = 1e-6
"""Retardation time [s] of the compliance that sets in at once: far below a step."""

SAMPLED_AT = 0.4
"""Part of its period after which a controller that holds takes a sample."""


@njit(cache=True, nogil=True)
def relaxed(p, h, s):
    """The stretch of a node without contact at the end of a step; the literal law forgets it."""
    return 0.0 if p.literal else s * (1 - h * p.K_t / (p.R_t + h * p.K_t))


@njit(cache=True, nogil=True)
def friction(p, k, age, worn):
    """mu_s and mu_k of a node on pad k that has stuck for the time `age` [s], where wear has left
    the part `worn` of them."""
    of_pad = worn * (p.upper_friction if k == 1 else 1.0)
    return of_pad * (p.mu_s + p.ageing * np.log(1 + age / p.ageing_time)), of_pad * p.mu_k


@njit(cache=True, nogil=True)
def aged(p, h, age, slip):
    """How long a node has stuck [s] at the end of a step in which it slips at a speed [m/s]."""
    return (age + h) / (1 + h * slip / p.renewed)


@njit(cache=True, nogil=True)
def centre_of_mass(p, theta):
    """From the contour's centre to the centre of mass, (2,) [m]."""
    return (
        p.com_x * np.cos(theta) - p.com_y * np.sin(theta),
        p.com_x * np.sin(theta) + p.com_y * np.cos(theta),
    )


@njit(cache=True, nogil=True)
def node(p, h, theta, rx, ry, omega, dx, dy, s, slipping, mu_s, mu_k):
    """One node at the end of a step, for speeds rx, ry of the node against the disc's centre and
    the spin.

    d is from the centre to the node at the beginning, theta the disc's angle and s the stretch
    there. Returns the force on the node fx, fy, the torque on the disc about the centre of mass,
    the new stretch, whether it slips by the literal law, and the speed of slip.
    """
    dx, dy = dx + h * rx, dy + h * ry
    far = np.sqrt(dx * dx + dy * dy)
    nx, ny = dx / far, dy / far
    g, g_dot, v = p.radius - far, -(nx * rx + ny * ry), far * omega - (nx * ry - ny * rx)
    if g <= 0.0:
        return 0.0, 0.0, 0.0, relaxed(p, h, s), False, 0.0
    spring = p.K_n * g if p.power == 1.0 else p.K_n * p.same * (g / p.same) ** p.power
    damping = p.R_n * g_dot
    F_N = max(0.0, spring + damping)
    if damping > 0.0:
        damping = min(damping, 3.0 * spring)
        F_N = spring + damping - damping**3 / (27.0 * spring * spring)
    if p.literal:
        stretch = s + h * v
        e = p.K_t * stretch + p.R_t * v
        slips, rate = abs(e) > mu_s * F_N, 0.0
        if slipping:
            e, rate = mu_k * F_N * v / np.sqrt(v * v + CREEP * CREEP), abs(v)
        e *= g / (g + TAKEN_IN)
    else:
        R = p.R_t + h * p.K_t
        trial = p.K_t * s + R * v
        a, free = R, abs(trial)
        b, c = a * p.v_s - (free - mu_k * F_N), p.v_s * max(0.0, free - mu_s * F_N)
        rate = 2 * c / (b + np.sqrt(b * b + 4 * a * c)) if c > 0.0 and b > 0.0 else 0.0
        if c > 0.0 and b <= 0.0:
            rate = (np.sqrt(b * b + 4 * a * c) - b) / (2 * a)
        stretch = s + h * (v - np.sign(trial) * rate)
        e = p.K_t * stretch + p.R_t * (stretch - s) / h
        slips = False
    F_N -= p.adhesion * g / (g + TAKEN_IN)
    fx, fy = F_N * nx - e * ny, F_N * ny + e * nx
    cx, cy = centre_of_mass(p, theta + h * omega)
    return fx, fy, cx * fy - cy * fx - far * e, stretch, slips, rate


@njit(cache=True, nogil=True)
def linearise(p, h, theta, rx, ry, omega, dx, dy, s, slipping, mu_s, mu_k, share, f, slope):
    """Force (fx, fy, torque) of a node that stands for `share` spacings of surface, and its slopes
    (3, 3) by rx, ry, omega."""
    at = node(p, h, theta, rx, ry, omega, dx, dy, s, slipping, mu_s, mu_k)[:3]
    for b in range(3):
        by = DIFFERENCE if b < 2 else DIFFERENCE / p.radius
        vx, vy, spin = rx + by * (b == 0), ry + by * (b == 1), omega + by * (b == 2)
        moved = node(p, h, theta, vx, vy, spin, dx, dy, s, slipping, mu_s, mu_k)[:3]
        for a in range(3):
            f[a] = share * at[a]
            slope[a, b] = share * (moved[a] - at[a]) / by


@njit(cache=True, nogil=True)
def control(p, q, w, z, h):
    """Forces that the two loops ask for, for velocities z at the end of a step, with their slopes
    by the velocities that they measure. q are the poses (x_C, y_C, theta, x_Br, y_Br) before
    it, w (signals, 2) the reference after it."""
    i = 0 if p.senses_disc else 3
    F_x = p.K_x * (w[0, 0] - q[i] - h * z[i]) + p.R_x * (w[0, 1] - z[i])
    F_y = p.K_y * (w[1, 0] - q[4] - h * z[4]) + p.R_y * (w[1, 1] - z[4]) + w[2, 0]
    return F_x, F_y, p.K_x * h + p.R_x, p.K_y * h + p.R_y


@njit(cache=True, nogil=True)
def reaches(p, h, a, asked, slope, past, before):
    """Force of loop a that reaches the bracket at the end of a step, and its slope.

    `asked` is what the controller asks for then, past (steps, 2) what it asked for at the ends of
    the steps before, the latest first, and before (2,) what reached the bracket last.
    """
    late = int(p.delay / h + 1e-6)
    part = max(0.0, p.delay / h - late)
    if late == 0:
        force, slope = (1 - part) * asked + part * past[0, a], (1 - part) * slope
    else:
        force, slope = (1 - part) * past[late - 1, a] + part * past[late, a], 0.0
    most = p.F_x_most if a == 0 else p.F_y_most
    if abs(force) > most:
        force, slope = np.sign(force) * most, 0.0
    if p.lag > 0.0:
        force = (p.lag * before[a] + h * force) / (p.lag + h)
        slope *= h / (p.lag + h)
    return force, slope


@njit(cache=True, nogil=True)
def drive(p, h, q, w, z, ahead, held, past, before):
    """Forces of both loops that reach the bracket, with their slopes; `ahead` is the time [s] from
    the poses q to what is asked for, held (2,) what a controller that holds asks for."""
    x, y, by_x, by_y = control(p, q, w, z, ahead)
    if p.hold > 0.0:
        x, y, by_x, by_y = held[0], held[1], 0.0, 0.0
    F_x, by_x = reaches(p, h, 0, x, by_x, past, before)
    F_y, by_y = reaches(p, h, 1, y, by_y, past, before)
    return F_x, F_y, by_x, by_y


@njit(cache=True, nogil=True)
def near_nodes(p, X, share, q, u, margin):
    """Pads and numbers (m, 2) of the nodes that may touch, where they are from the centre (m, 2),
    and their shares (m,)."""
    every = X + u
    every[1] += q[3:]
    every -= q[:2]
    which = np.argwhere(every[..., 0] ** 2 + every[..., 1] ** 2 < (p.radius + margin) ** 2)
    d = np.empty((len(which), 2))
    for j in range(len(which)):
        d[j] = every[which[j, 0], which[j, 1]]
    return which, d, share[which[:, 1]]


@njit(cache=True, nogil=True)
def retarded(p, h):
    """Parts of the pads' compliance, the main, the slow and the one at once, and what each moves by
    in a step, over that and the step: (3,) and (3,) [1/s]."""
    parts = np.array([1 - p.slow - p.fast, p.slow, p.fast])
    return parts, 1 / (np.array([p.tau, p.slow_tau, AT_ONCE]) + h)


@njit(cache=True, nogil=True)
def resistance(p, v):
    """Force of the horizontal guide at a speed v, and its slope."""
    fast = np.sqrt(v * v + p.creep * p.creep)
    return -p.friction * v / fast, -p.friction * p.creep * p.creep / fast**3


@njit(cache=True, nogil=True)
def balance(p, h, C, which, d, shares, q, v, u, s, slipping, ages, now, loops, w, z, r, J):
    """What is left over of all equations, r (n,), and its derivatives J (n, n), for the velocities
    z at the end of the step.

    z = (disc x, y, spin, bracket x, y, then x and y of each near node against its base).
    """
    J[:] = np.eye(len(z))
    inertia = 0.5 * p.inertia * p.mass * p.radius**2
    gain = h / np.array([p.mass, p.mass, inertia, p.bracket_mass, p.bracket_mass])
    soft, worn = now
    held, past, before = loops
    F_x, F_y, by_x, by_y = drive(p, h, q, w, z, h, held, past, before)
    r[:5] = z[:5] - v
    cx, cy = centre_of_mass(p, q[2])
    ex, ey = centre_of_mass(p, q[2] + h * z[2])
    r[0] += v[2] * cy - z[2] * ey
    r[1] += z[2] * ex - v[2] * cx
    J[0, 2] -= ey + h * z[2] * ex
    J[1, 2] += ex - h * z[2] * ey
    r[0] -= h * p.gravity * np.sin(p.tilt)
    r[1] += h * p.gravity * np.cos(p.tilt)
    against, by_against = resistance(p, z[3])
    r[3] -= gain[3] * (F_x + against)
    J[3, 3] -= gain[3] * by_against
    r[4] -= gain[4] * F_y
    J[3, 0 if p.senses_disc else 3] += gain[3] * by_x
    J[4, 4] += gain[4] * by_y
    parts, rate = retarded(p, h)
    give = (parts * rate).sum()
    f, slope = np.empty(3), np.empty((3, 3))
    for j in range(len(which)):
        for a in range(2):
            r[5 + 2 * j + a] = z[5 + 2 * j + a] + (rate * u[:, which[j, 0], which[j, 1], a]).sum()
    for j in range(len(which)):
        k, i = which[j]
        rx, ry = z[5 + 2 * j] + k * z[3] - z[0], z[6 + 2 * j] + k * z[4] - z[1]
        mu_s, mu_k = friction(p, k, ages[k, i], worn)
        linearise(
            p, h, q[2], rx, ry, z[2], d[j, 0], d[j, 1], s[k, i], slipping[k, i], mu_s, mu_k,
            shares[j], f, slope,
        )  # fmt: skip
        for a in range(2):
            load(r, J, a, gain[a], f[a], slope[a], j, k)
            load(r, J, 3 + a, -k * gain[3 + a], f[a], slope[a], j, k)
        load(r, J, 2, -gain[2], f[2], slope[2], j, k)
        for other in range(len(which)):
            if which[other, 0] == k:
                for a in range(2):
                    for b in range(2):
                        moves = C[k, 2 * which[other, 1] + a, 2 * i + b] * give * soft
                        load(r, J, 5 + 2 * other + a, -moves, f[b], slope[b], j, k)


@njit(cache=True, nogil=True)
def load(r, J, row, gain, force, slope, j, k):
    """Adds a force of near node j, on pad k, to an equation, with its slopes by the node's speeds
    and the spin."""
    r[row] += gain * force
    J[row, 2] += gain * slope[2]
    for b in range(2):
        by = gain * slope[b]
        J[row, 5 + 2 * j + b] += by
        J[row, b] -= by
        J[row, 3 + b] += k * by


@njit(cache=True, nogil=True)
def largest(p, x):
    """The largest of velocities like z [m/s]; the spin counts by what it moves the rim."""
    out = 0.0
    for a in range(len(x)):
        out = max(out, abs(x[a]) * (p.radius if a == 2 else 1.0))
    return out


@njit(cache=True, nogil=True)
def step(p, h, C, X, share, q, v, u, u_dot, s, slipping, ages, now, loops, w, margin):
    """One step in place: poses q and velocities v (5,) of disc and bracket, and by pad (2, ...) the
    parts of displacements (3, 2, nodes, 2) and the rates of their sum, stretches s, the literal
    law's flags and how long nodes have stuck. `now` are the pads' compliance over that of the
    begin, and what wear has left of friction; `loops` are what `drive` takes at its end. Returns
    whether it was solved, the fastest slip, and how many nodes touch. Newton's change is halved
    where it would leave more over than there was."""
    which, d, shares = near_nodes(p, X, share, q, u.sum(0), margin)
    n = 5 + 2 * len(which)
    z, r, J = np.empty(n), np.empty(n), np.empty((n, n))
    change, scale, before = np.zeros(n), 1.0, np.inf
    z[:5] = v
    for j in range(len(which)):
        z[5 + 2 * j : 7 + 2 * j] = u_dot[which[j, 0], which[j, 1]]
    for _ in range(MOST):
        balance(p, h, C, which, d, shares, q, v, u, s, slipping, ages, now, loops, w, z, r, J)
        left = largest(p, r)
        if left > before and scale > SHORTEST:
            scale *= 0.5
            z += scale * change
            continue
        change, scale, before = np.linalg.solve(J, r), 1.0, left
        z -= change
        if largest(p, change) < SOLVED:
            return finish(p, h, C, X, shares, q, v, u, u_dot, s, slipping, ages, now, z, which, d)
    return False, 0.0, 0


@njit(cache=True, nogil=True)
def finish(p, h, C, X, shares, q, v, u, u_dot, s, slipping, ages, now, z, which, d):
    """Takes the velocities z over, unless a node touches the disc that was not looked at."""
    soft, worn = now
    fastest, touching, displaced = 0.0, 0, np.zeros(u.shape[1:])
    stretches, flags, older = np.empty(s.shape), np.zeros(s.shape, np.bool_), np.zeros(s.shape)
    for k in range(2):
        for i in range(s.shape[1]):
            stretches[k, i] = relaxed(p, h, s[k, i])
    apart = np.ones(s.shape, np.bool_)
    for j in range(len(which)):
        k, i = which[j]
        rx, ry = z[5 + 2 * j] + k * z[3] - z[0], z[6 + 2 * j] + k * z[4] - z[1]
        mu_s, mu_k = friction(p, k, ages[k, i], worn)
        fx, fy, _, stretch, flag, slip = node(
            p, h, q[2], rx, ry, z[2], d[j, 0], d[j, 1], s[k, i], slipping[k, i], mu_s, mu_k
        )
        stretches[k, i], flags[k, i], apart[k, i] = stretch, flag, False
        fastest = max(fastest, slip)
        if fx != 0.0 or fy != 0.0:
            touching, older[k, i] = touching + 1, aged(p, h, ages[k, i], slip)
        moved = shares[j] * (fx * C[k, :, 2 * i] + fy * C[k, :, 2 * i + 1])
        displaced[k] += soft * moved.reshape(-1, 2)
    parts, rate = retarded(p, h)
    rates = np.empty(u.shape)
    for m in range(3):
        rates[m] = rate[m] * (parts[m] * displaced - u[m])
    summed = rates.sum(0)
    for k in range(2):
        place = X[k] + u[:, k].sum(0) + k * q[3:] - q[:2]
        place += h * (summed[k] + k * z[3:5] - z[:2])
        if (apart[k] & ((place**2).sum(1) < p.radius**2)).any():
            return False, 0.0, 0
    u += h * rates
    u_dot[:], s[:], slipping[:], ages[:] = summed, stretches, flags, older
    q += h * z[:5]
    v[:] = z[:5]
    return True, fastest, touching


@njit(cache=True, nogil=True)
def march(p, h, C, X, share, q, v, u, signals, every):
    """All steps; rows every so many of them: poses, velocities, the loops' forces, the fastest slip
    since the last row, and the nodes that touch (14 numbers). Returns the rows and the number of
    the step that could not be solved, or -1."""
    steps, count = len(signals) - 1, X.shape[1]
    u_dot, s, slipping = np.zeros(u.shape), np.zeros((2, count)), np.zeros((2, count), np.bool_)
    rows, fastest, ages = np.zeros((steps // every + 1, 14)), 0.0, np.zeros((2, count))
    parts = np.stack(((1 - p.slow - p.fast) * u, p.slow * u, p.fast * u))
    held, past, before = np.empty(2), np.empty((int(p.delay / h) + 2, 2)), np.empty(2)
    loops, samples = (held, past, before), 0
    for i in range(steps + 1):
        touching = 0
        if i > 0:
            now = 1 / (1 - p.softening * i / steps), 1 - p.wear * i / steps
            solved, margin = False, MARGIN
            for _ in range(4):
                solved, slip, touching = step(
                    p, h, C, X, share, q, v, parts, u_dot, s, slipping, ages, now, loops,
                    signals[i], margin,
                )  # fmt: skip
                if solved:
                    break
                margin *= 4
            if not solved:
                return rows, i
            fastest = max(fastest, slip)
        asked_x, asked_y, _, _ = control(p, q, signals[i], v, 0.0)
        if i == 0:
            held[0], held[1] = asked_x, asked_y
            past[:] = held
            before[0], before[1] = asked_x, asked_y
        F_x, F_y, _, _ = drive(p, h, q, signals[i], v, 0.0, held, past, before)
        before[0], before[1] = F_x, F_y
        if p.hold > 0.0 and int(i * h / p.hold + 1 - SAMPLED_AT + 1e-6) > samples:
            samples += 1
            held[0], held[1] = asked_x, asked_y
        past[1:] = past[:-1].copy()
        past[0, 0], past[0, 1] = asked_x, asked_y
        if p.hold > 0.0:
            past[0] = held
        if i % every == 0:
            row = rows[i // every]
            row[:5], row[5:10] = q, v
            row[10], row[11], row[12], row[13] = F_x, F_y, fastest, touching
            fastest = 0.0
    return rows, -1
