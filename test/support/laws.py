# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Independent numpy versions of every force law, as references for the engine.

They use other formulas than the engine. Positions and velocities are (3, n), as in the engine.
"""

from typing import NamedTuple

import numpy as np
from scipy.linalg import expm_frechet
from scipy.spatial.transform import Rotation

from cloth_sim_ros.physics.model.forces.air_panels import AirPanels
from cloth_sim_ros.physics.model.forces.altitude import AltitudeSprings
from cloth_sim_ros.physics.model.forces.candidates import CandidateSprings
from cloth_sim_ros.physics.model.forces.contact import Contact
from cloth_sim_ros.physics.model.forces.crossed import CrossedSprings
from cloth_sim_ros.physics.model.forces.drag import Drag
from cloth_sim_ros.physics.model.forces.gravity import Gravity
from cloth_sim_ros.physics.model.forces.grid_springs import GridSprings
from cloth_sim_ros.physics.model.forces.grips import Grips
from cloth_sim_ros.physics.model.forces.membrane_triangles import MembraneTriangles
from cloth_sim_ros.physics.model.forces.pair_springs import PairSprings
from cloth_sim_ros.physics.model.forces.wind import Wind


class Values(NamedTuple):
    """Results of a force in one state."""

    force: np.ndarray
    energy: float = 0.0
    dissipation: float = 0.0
    external_power: float = 0.0


def pair_springs(x, v, pairs, rest_lengths, stiffness, damping):
    """S1 where the rest length is above 0, S4 where it is 0: stiffness is k_s [N] and k [N/m]."""
    f, energy, dissipation = np.zeros_like(x), 0.0, 0.0
    for (a, b), l0, k, k_d in zip(pairs, rest_lengths, stiffness, damping, strict=True):
        s, u = x[:, b] - x[:, a], v[:, b] - v[:, a]
        length = np.linalg.norm(s)
        if l0 == 0.0:
            push = -k * s - k_d * u
            energy += 0.5 * k * length**2
            dissipation += k_d * (u @ u)
        else:
            d = s / length
            push = -k * (length / l0 - 1.0) * d - k_d * (u @ d) * d
            energy += 0.5 * k * l0 * (length / l0 - 1.0) ** 2
            dissipation += k_d * (u @ d) ** 2
        f[:, b] += push
        f[:, a] -= push
    return Values(f, energy, dissipation)


#: How a family's springs lead from their first end: rows down and columns to the right.
LEADS = {
    "right": (0, 1),
    "down": (1, 0),
    "diagonal": (1, 1),
    "antidiagonal": (1, -1),
    "right2": (0, 2),
    "down2": (2, 0),
}


def grid_springs(x, v, rows, columns, families):
    """Springs of a sheet, enumerated cell by cell."""
    pairs, rest_lengths, stiffness, damping = [], [], [], []
    for family in families:
        down, right = LEADS[family.name]
        for row in range(rows):
            for column in range(columns):
                to = row + down, column + right
                if not (0 <= to[0] < rows and 0 <= to[1] < columns):
                    continue
                cell = min(row, to[0]) + min(column, to[1])
                if family.parity is not None and cell % 2 != family.parity:
                    continue
                along_border = (down == 0 and row in (0, rows - 1)) or (right == 0 and column in (0, columns - 1))
                share = family.border if along_border else 1.0
                pairs.append((row * columns + column, to[0] * columns + to[1]))
                rest_lengths.append(family.rest_length)
                stiffness.append(share * family.stiffness)
                damping.append(share * family.damping)
    return pair_springs(x, v, pairs, rest_lengths, stiffness, damping)


def _sign(order):
    """1 for an even order of four things, -1 for an odd one."""
    return round(np.linalg.det(np.eye(4)[list(order)]))


def volume(p):
    """6V of four points (4, 3): positive where the wings, 2 and 3, rise to the side of the normal."""
    return np.dot(p[1] - p[0], np.cross(p[2] - p[0], p[3] - p[0]))


def edge_edge(p, i, j, k, m):
    """Return the signed distance of the lines i-j and k-m of four points (4, 3), its gradient (4, 3), and |a x b|.

    Each end's share follows from the feet of the common normal, which are not clamped.
    """
    a, b = p[j] - p[i], p[m] - p[k]
    cross = np.cross(b, a)
    area = np.linalg.norm(cross)
    n = _sign((i, j, k, m)) * cross / area
    # p_i + s a + q n = p_k + t b
    s, t, q = np.linalg.solve(np.stack((a, -b, n), axis=1), p[k] - p[i])
    gradient = np.zeros((4, 3))
    gradient[[i, j, k, m]] = np.outer([s - 1.0, -s, 1.0 - t, t], n)
    return q, gradient, area


def point_face(p, i, j, k, m):
    """Signed height of point m over the face i, j, k, its gradient (4, 3), and |a x b| of the face."""
    a, b = p[j] - p[i], p[k] - p[i]
    cross = np.cross(a, b)
    area = np.linalg.norm(cross)
    n = _sign((i, j, k, m)) * cross / area
    # The foot of the height, p_i + s a + t b.
    s, t, q = np.linalg.solve(np.stack((a, b, n), axis=1), p[m] - p[i])
    gradient = np.zeros((4, 3))
    gradient[[i, j, k, m]] = np.outer([s + t - 1.0, -s, -t, 1.0], n)
    return q, gradient, area


def candidates(p):
    """Lengths, gradients and areas of the seven candidates of four points (4, 3), S8's first."""
    edges = [edge_edge(p, *order) for order in ((0, 1, 2, 3), (0, 2, 1, 3), (0, 3, 1, 2))]
    return edges + [point_face(p, *order) for order in ((0, 1, 2, 3), (0, 1, 3, 2), (0, 2, 3, 1), (1, 2, 3, 0))]


def crossed_length(p):
    """S8: length and gradient of one hinge (4, 3); M^2 = |a x b|^2 + (0.1 |a|^2)^2 of the lines' directions a, b."""
    h, slope, area = edge_edge(p, 0, 1, 2, 3)
    a = p[1] - p[0]
    more = 0.1 * (a @ a)
    whole = np.hypot(area, more)
    # h = d area / whole of the lines' distance d, whose gradient is known: so is that of the area, by 6V = d area.
    b, n = p[3] - p[2], np.cross(a, p[3] - p[2])
    along = np.cross(b, n) / area, np.cross(n, a) / area
    area_slope = np.stack((-along[0], along[0], -along[1], along[1]))
    share = area / whole
    turn = np.stack((-a, a, 0.0 * a, 0.0 * a)) * 0.2 * more / whole
    return h * share, share * slope + h * (area_slope - share * (share * area_slope + turn)) / whole


def blended_length(p):
    """S9: 1/h^2 = 1/2 sum of 1/h_c^2 over the candidates, and its gradient sum of 1/2 (M_c/M)^3 grad h_c."""
    seven = candidates(p)
    whole = np.sqrt(0.5 * sum(area**2 for _, _, area in seven))
    gradient = sum(0.5 * (area / whole) ** 3 * slope for _, slope, area in seven)
    return volume(p) / whole, gradient


def hinge_springs(length, x, v, hinges, rest_lengths, stiffness, damping):
    """S8 or S9: energy k (h - h0)^2 / 2, damping -k_d (grad h . v) grad h."""
    f, energy, dissipation = np.zeros_like(x), 0.0, 0.0
    for hinge, h0, k, k_d in zip(hinges, rest_lengths, stiffness, damping, strict=True):
        h, gradient = length(x.T[hinge])
        rate = np.sum(gradient * v.T[hinge])
        f[:, hinge] -= ((k * (h - h0) + k_d * rate) * gradient).T
        energy += 0.5 * k * (h - h0) ** 2
        dissipation += k_d * rate**2
    return Values(f, energy, dissipation)


def membrane(x, v, triangles, corners, moduli, viscosities):
    """St. Venant-Kirchhoff: second Piola-Kirchhoff stress S = C : E + size D : dE/dt, force -A F S grad N.

    F maps a triangle's rest plane, by its threads, to space. N are the linear shape functions of its corners.
    """
    f, energy, dissipation = np.zeros_like(x), 0.0, 0.0
    slopes = np.array([[-1.0, -1.0], [1.0, 0.0], [0.0, 1.0]])
    tensors = [
        np.array([[c11, c12, 0.0], [c12, c22, 0.0], [0.0, 0.0, c33]]) for c11, c12, c22, c33 in (moduli, viscosities)
    ]
    for triangle, points in zip(triangles, corners, strict=True):
        sides = np.stack((points[1] - points[0], points[2] - points[0]), axis=1)
        shapes = slopes @ np.linalg.inv(sides)
        area = 0.5 * abs(np.linalg.det(sides))
        gradient, rate = x[:, triangle] @ shapes, v[:, triangle] @ shapes
        strain, strain_rate = 0.5 * (gradient.T @ gradient - np.eye(2)), rate.T @ gradient
        strain_rate = 0.5 * (strain_rate + strain_rate.T)
        vectors = [np.array([e[0, 0], e[1, 1], 2.0 * e[0, 1]]) for e in (strain, strain_rate)]
        elastic, viscous = tensors[0] @ vectors[0], np.sqrt(2.0 * area) * tensors[1] @ vectors[1]
        s = elastic + viscous
        f[:, triangle] -= area * gradient @ np.array([[s[0], s[2]], [s[2], s[1]]]) @ shapes.T
        energy += 0.5 * area * vectors[0] @ elastic
        dissipation += area * vectors[1] @ viscous
    return Values(f, energy, dissipation)


def air_panels(x, v, panels, normal, tangential, wind):
    """Return F = -A/k (c_n n n' + c_t (1 - n n')) (v - w) on each of a panel's k corners; zero without an area."""
    f, dissipation, external_power = np.zeros_like(x), 0.0, 0.0
    for panel in panels:
        p = x.T[panel]
        area_vector = 0.5 * (np.cross(p[1] - p[0], p[2] - p[0]) if len(p) == 3 else np.cross(p[2] - p[0], p[3] - p[1]))
        area = np.linalg.norm(area_vector)
        if not area > 1e-15:
            continue
        across = np.outer(area_vector, area_vector) / area**2
        drag = area / len(p) * (normal * across + tangential * (np.eye(3) - across))
        for corner in panel:
            f[:, corner] -= drag @ (v[:, corner] - wind)
            dissipation += v[:, corner] @ drag @ v[:, corner]
            external_power += wind @ drag @ v[:, corner]
    return Values(f, 0.0, dissipation, external_power)


def air_energy(x, v, panels, density, wind):
    """Return T = rho / 2 sum of A/k (n . (v - w))^2 over the k corners of each panel."""
    energy = 0.0
    for panel in panels:
        p = x.T[panel]
        area_vector = 0.5 * (np.cross(p[1] - p[0], p[2] - p[0]) if len(p) == 3 else np.cross(p[2] - p[0], p[3] - p[1]))
        fluxes = (v.T[panel] - wind) @ area_vector
        energy += 0.5 * density / len(p) * fluxes @ fluxes / np.linalg.norm(area_vector)
    return energy


def lagrange_accelerations(masses, panels, density, wind, x, v):
    """Return the accelerations (3, n) of particles that carry air, from derivatives of the kinetic energy alone.

    Momenta are exact differences, because the energy is of second degree in the velocities. Derivatives with respect
    to positions are central differences of order 4.
    """
    shape, size = x.shape, x.size
    units = [unit.reshape(shape) for unit in np.eye(size)]

    def energy(at, speed):
        return 0.5 * float(np.sum(masses * speed * speed)) + air_energy(at, speed, panels, density, wind)

    def slope(function, h=1e-5):
        single, double = function(h) - function(-h), function(2.0 * h) - function(-2.0 * h)
        return (8.0 * single - double) / (12.0 * h)

    def momenta(at, speed):
        return np.array([0.5 * (energy(at, speed + unit) - energy(at, speed - unit)) for unit in units])

    mass = np.array([momenta(x, v + unit) - momenta(x, v) for unit in units]).T
    change = slope(lambda h: momenta(x + h * v, v))
    gradient = np.array([slope(lambda h, unit=unit: energy(x + h * unit, v)) for unit in units])
    return np.linalg.solve(mass, gradient - change).reshape(shape)


def pose(path, t):
    """Return position, velocity, rotation matrix and its rate of a gripper at a time [s]."""
    s = t - path[0]
    powers, slopes = s ** np.arange(4), np.array([0.0, 1.0, 2.0 * s, 3.0 * s**2])
    places, turns = path[1:13].reshape(4, 3), np.concatenate([np.zeros((1, 3)), path[17:26].reshape(3, 3)])
    turn, rate = (_cross_matrix(weights @ turns) for weights in (powers, slopes))
    turned, turning = expm_frechet(turn, rate)
    first = Rotation.from_quat(path[13:17]).as_matrix()
    return powers @ places, slopes @ places, turned @ first, turning @ first


def _cross_matrix(r):
    return np.array([[0.0, -r[2], r[1]], [r[2], 0.0, -r[0]], [-r[1], r[0], 0.0]])


def grips(t, x, v, force):
    """Return S4 to points of grippers; then force, torque, power on the cloth and dissipated power of each gripper."""
    f, energy = np.zeros_like(x), 0.0
    booked = np.zeros((force.gripper_count, 8))
    for gripper, path in enumerate(force.paths):
        position, velocity, rotation, turning = pose(path, t)
        for grip in range(force.starts[gripper], force.starts[gripper + 1]):
            particle, k, k_d = force.particles[grip], force.stiffness[grip], force.damping[grip]
            arm, speed = rotation @ force.offsets[grip], velocity + turning @ force.offsets[grip]
            s, u = x[:, particle] - position - arm, v[:, particle] - speed
            push = -k * s - k_d * u
            f[:, particle] += push
            energy += 0.5 * k * (s @ s)
            booked[gripper] += [*-push, *np.cross(arm, -push), push @ speed, k_d * (u @ u)]
    return Values(f, energy, float(booked[:, 7].sum())), booked


#: U of contact [m/s].
STOPPING_SPEED = 35.0


def contact(t, x, v, force, masses):
    """Return forces of obstacles; then force, torque, power on the cloth and dissipated power of each obstacle.

    The energy of a mass is U^2/2 (1 - s)^4 / s; its slope is calculated term by term of 1/s - 4 + 6 s - 4 s^2 + s^3.
    """
    f, energy, d = np.zeros_like(x), 0.0, force.thickness
    booked = np.zeros((len(force.obstacles), 8))
    for k, (obstacle, path) in enumerate(zip(force.obstacles, force.paths, strict=True)):
        position, velocity, rotation, turning = pose(path, t)
        gaps, normals = obstacle.distance((x.T - position) @ rotation)
        for i in np.flatnonzero(gaps < d):
            s, normal, arm = gaps[i] / d, rotation @ normals[i], x[:, i] - position
            surface = velocity + turning @ rotation.T @ arm
            closing = -(v[:, i] - surface) @ normal
            elastic = STOPPING_SPEED**2 / 2.0 / d * (1.0 / s**2 - 6.0 + 8.0 * s - 3.0 * s**2)
            u = force.damping * closing / (1.0 + force.damping * elastic / (STOPPING_SPEED / 2.0 / d))
            push = masses[i] * elastic * (0.5 * u + np.sqrt(1.0 + 0.25 * u * u)) * normal
            f[:, i] += push
            energy += masses[i] * STOPPING_SPEED**2 / 2.0 * (1.0 - s) ** 4 / s
            dissipation = (push - masses[i] * elastic * normal) @ normal * closing
            booked[k] += [*-push, *np.cross(arm, -push), push @ surface, dissipation]
    return Values(f, energy, float(booked[:, 7].sum())), booked


def friction(anchor_offset, normal, slip, push, coefficients, frequency):
    """Acceleration of friction, by how much its spring is stretched then, and whether it slides, for one contact.

    Args:
        anchor_offset: from the anchor to the particle.
        normal: off the obstacle.
        slip: velocity seen from the obstacle.
        push: acceleration across the surface.
        coefficients: coefficients at rest and in motion.
        frequency: of the spring; its damping is a tenth of critical.
    """
    across = np.eye(3) - np.outer(normal, normal)
    stretch, speed = across @ anchor_offset, across @ slip
    # At rest up to 0.01 m/s, in motion from 0.02 m/s on, smoothly between.
    part = min(max((1.0 - speed @ speed / 0.02**2) / 0.75, 0.0), 1.0)
    most = push * (coefficients[1] + (coefficients[0] - coefficients[1]) * part**2 * (3.0 - 2.0 * part))
    slides = frequency**2 * np.linalg.norm(stretch) > most
    if slides:
        stretch = stretch / np.linalg.norm(stretch) * most / frequency**2
    spring, damped = frequency**2 * stretch, 0.2 * frequency * speed
    # As much damping as keeps the sum within the cone: |spring + part damped|^2 = most^2.
    part = max(np.roots([damped @ damped, 2.0 * spring @ damped, spring @ spring - most**2]).real)
    return -spring - min(max(part, 0.0), 1.0) * damped, stretch, slides


def values(force, t, x, v, masses):
    """Return the results of one of the engine's forces, by the laws above."""
    if isinstance(force, Contact):
        return contact(t, x, v, force, masses)[0]
    if isinstance(force, Grips):
        return grips(t, x, v, force)[0]
    if isinstance(force, GridSprings):
        return grid_springs(x, v, force.rows, force.columns, force.families)
    if isinstance(force, PairSprings):
        return pair_springs(x, v, force.pairs, force.rest_length, force.stiffness, force.damping)
    if isinstance(force, CandidateSprings):
        length = edge_edge if force.kind == "edge_edge" else point_face
        rows = force.hinges, force.rest_length, force.stiffness, force.damping
        return hinge_springs(lambda p: length(p, 0, 1, 2, 3)[:2], x, v, *rows)
    if isinstance(force, (CrossedSprings, AltitudeSprings)):
        length = crossed_length if isinstance(force, CrossedSprings) else blended_length
        return hinge_springs(length, x, v, force.hinges, force.rest_length, force.stiffness, force.damping)
    if isinstance(force, MembraneTriangles):
        return membrane(x, v, force.triangles, force.corners, force.moduli, force.viscosities)
    if isinstance(force, AirPanels):
        return air_panels(x, v, force.panels, force.normal, force.tangential, force.wind)
    if isinstance(force, Gravity):
        weight = np.outer(force.acceleration, masses)
        return Values(weight, -float(np.sum(weight * x)))
    if isinstance(force, Drag):
        return Values(-force.rate * masses * v, 0.0, force.rate * float(np.sum(masses * v * v)))
    if isinstance(force, Wind):
        push = np.outer(force.acceleration, masses)
        return Values(push, 0.0, 0.0, float(np.sum(push * v)))
    raise TypeError(f"no law is written down for {type(force).__name__}")


def total(model, t, x, v):
    """Return the sum over a model's forces, also on anchored particles."""
    values_by_force = [values(force, t, x, v, model.masses) for force in model.forces]
    return Values(sum(e.force for e in values_by_force), *(sum(e[k] for e in values_by_force) for k in (1, 2, 3)))


def leapfrog(model, t, duration, x, v, steps):
    """Return positions and velocities by the steps of docs/derivations/time_stepping.md and the laws above."""

    def accelerations(now, places, speeds):
        return total(model, now, places, speeds).force * model.inverse_masses

    h = duration / steps
    x, v = x.copy(), v * (model.inverse_masses > 0.0)
    last = before = accelerations(t, x, v)
    for k in range(steps):
        x = x + 0.5 * h * v
        a = accelerations(t + (k + 0.5) * h, x, v + 0.25 * h * (last + before))
        v = v + h * a
        x = x + 0.5 * h * v
        last, before = a, last
    return x, v
