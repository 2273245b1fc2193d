# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Grasped particles of a recorded cloth, also if they are hidden."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence

import attrs
import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.fit.parameters import FitError
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.model.sheets.grid import GridSheet
from cloth_sim_ros.physics.plan.gripper_path import rotation_matrix
from cloth_sim_ros.scene.scene import Scene

#: Length of the examined beginning of the recording [s].
GRASP_SPAN = 1.0
#: Number of candidates, which are the particles nearest to the gripper. Number of visible neighbours in the rest shape
#: from which a hidden particle's position is extrapolated.
_N_CANDIDATES, _N_NEIGHBOURS = 24, 9
#: Distance to the bisecting plane from which a choice is certain [standard deviations].
_CERTAINTY_SIGMAS = 3.0
#: Standard deviation of the camera calibration and of the cloth's position between the fingers [m].
_CALIBRATION_SIGMA = 0.002


@attrs.frozen(kw_only=True)
class GraspedParticles:
    """Particles that one gripper holds from the first cloud on, and how far it is from them and from the others."""

    #: Name of the gripper.
    gripper: str
    #: Indices of the particles; the first one lies at the gripper's origin unless the user named several.
    particles: tuple[int, ...]
    #: Distance of the first particle from the gripper's origin in the clouds [m].
    distance: float
    #: Nearest particle that is not grasped, and its distance [m]; None if all are grasped.
    neighbour: int | None
    neighbour_distance: float
    #: True if an examined cloud shows the first particle.
    is_seen: bool
    #: True if the option --held names the particles.
    is_named: bool


@attrs.frozen(kw_only=True)
class _LocalPositions:
    """Particle positions in a gripper's frame, averaged over clouds, and their noise."""

    #: Mean positions [m], shape (n, 3); NaN if no cloud shows the particle.
    mean: Array
    #: Number of clouds that show each particle, shape (n,).
    n_seen: NDArray[np.int64]
    #: Standard deviation of one coordinate in one cloud [m].
    noise: float


def parse_grasped(scene: Scene, gripper: str, text: str) -> tuple[int, ...]:
    """Return the particle indices that a text such as ``12,13`` or ``top_left`` names. Raises FitError for other names.

    Raises:
        FitError: if a name is no particle, edge or corner.
    """
    sheet, count, particles = scene.sheet, len(scene.initial_positions()), list[int]()
    for name in (part.strip() for part in text.split(",")):
        if name.isdecimal() and len(name) < 12 and int(name) < count:
            particles.append(int(name))
            continue
        if name.isdecimal():
            raise FitError(f"--held {gripper} names particle {name[:20]}; there are {count}, from index 0")
        try:
            if not isinstance(sheet, GridSheet):
                raise ValueError(f"'{name}' is no particle index, and only a grid has edges and corners")
            particles += sheet.edge(name).tolist()
        except ValueError as error:
            raise FitError(f"--held {gripper}: {error}") from error
    return tuple(dict.fromkeys(particles))


def find_grasped(
    scene: Scene, gripper: str, clouds: Sequence[Array], poses: Sequence[Sequence[float]], known: Sequence[int] = ()
) -> tuple[GraspedParticles, Array]:
    """Return the particles that a closed gripper grasps, and all positions in its frame [m], (n, 3). Raises FitError.

    A hidden particle's position is extrapolated from its visible neighbours by a linear least-squares map of the rest
    shape. The gripper holds the particle nearest to its origin, and those within `gripper.radius` of it in the rest
    shape.

    Args:
        scene: the cloth.
        gripper: name of the gripper.
        clouds: matched clouds [m], shape (n, 3) each; NaN if a particle is hidden.
        poses: the gripper's pose at each cloud: position [m] and quaternion x, y, z, w.
        known: particles that the gripper is known to hold; if given, the clouds do not choose.

    Raises:
        FitError: if the clouds do not determine the grasped particle.
    """
    rest_shape, radius = scene.sheet.positions(), scene.gripper.radius
    local_positions = _mean_local_positions(clouds, poses)
    order = np.argsort(np.linalg.norm(_rough_positions(rest_shape, local_positions), axis=1), kind="stable")
    candidates = list(dict.fromkeys([*known, *order[:_N_CANDIDATES].tolist()]))
    positions = local_positions.mean.copy()
    errors = np.full(len(rest_shape), np.inf)
    for particle in candidates:
        positions[particle], errors[particle] = _extrapolate_position(rest_shape, local_positions, particle)
    distances = np.linalg.norm(positions[candidates], axis=1)
    order = np.argsort(distances, kind="stable")
    first = known[0] if known else candidates[int(order[0])]
    grasped = tuple(known) or particles_within(rest_shape, first, radius)
    free_particles = [candidates[k] for k in order if candidates[k] not in grasped]
    neighbour = free_particles[0] if free_particles else None
    result = GraspedParticles(
        gripper=gripper,
        particles=grasped,
        distance=float(np.linalg.norm(positions[first])),
        neighbour=neighbour,
        neighbour_distance=math.inf if neighbour is None else float(np.linalg.norm(positions[neighbour])),
        is_seen=bool(local_positions.n_seen[first]),
        is_named=bool(known),
    )
    if not known:
        _check_certainty(result, positions, errors, free_particles, radius + _spacing(rest_shape, first))
    # The origin lies at the grasped particle, or at the mean of the named ones.
    origin = np.mean([positions[particle] for particle in known], axis=0) if known else positions[first]
    for particle in grasped:
        if particle not in candidates:
            positions[particle] = _extrapolate_position(rest_shape, local_positions, particle)[0]
    return result, positions - origin


def find_grasped_at_rest(
    scene: Scene, gripper: str, position: Sequence[float], known: Sequence[int] = ()
) -> GraspedParticles:
    """Return the particles that a gripper at `position` [m] grasps in the scene's initial shape. Raises FitError.

    Raises:
        FitError: if a second particle is less than twice as far away.
    """
    start, rest_shape, radius = scene.initial_positions(), scene.sheet.positions(), scene.gripper.radius
    distances = np.linalg.norm(start - np.asarray(position), axis=1)
    first = known[0] if known else int(np.argmin(distances))
    grasped = tuple(known) or particles_within(rest_shape, first, radius)
    free_particles = [int(k) for k in np.argsort(distances, kind="stable") if k not in grasped]
    neighbour = free_particles[0] if free_particles else None
    result = GraspedParticles(
        gripper=gripper,
        particles=grasped,
        distance=float(distances[first]),
        neighbour=neighbour,
        neighbour_distance=math.inf if neighbour is None else float(distances[neighbour]),
        is_seen=False,
        is_named=bool(known),
    )
    if not known and result.neighbour_distance < 2.0 * result.distance:
        raise FitError(
            f"points carry no index, and gripper '{gripper}' is {1e3 * result.distance:.0f} mm from particle {first} "
            f"and {1e3 * result.neighbour_distance:.0f} mm from particle {neighbour} of the scene's initial shape: "
            f"the choice is uncertain. {_remedy(result)}"
        )
    return result


def describe_grasped(grasp: GraspedParticles, scene: Scene) -> str:
    """Return a sentence about a gripper's grasped particles and their distances."""
    names = ", ".join(_particle_name(scene, particle) for particle in grasp.particles[:8])
    more = f" and {len(grasp.particles) - 8} more" if len(grasp.particles) > 8 else ""
    basis = "by its position" if grasp.is_seen else "hidden, by its neighbours' positions"
    if grasp.is_named:
        basis = "as named"
    suffix = ""
    if grasp.neighbour is not None:
        suffix = f"; the next, {grasp.neighbour}, at {1e3 * grasp.neighbour_distance:.0f} mm"
    kind = "particle" if len(grasp.particles) == 1 else "particles"
    return f"Gripper '{grasp.gripper}' holds {kind} {names}{more} ({basis}): {1e3 * grasp.distance:.1f} mm off{suffix}."


def _check_certainty(
    grasped: GraspedParticles, positions: Array, errors: Array, free_particles: Sequence[int], reach: float
) -> None:
    first = grasped.particles[0]
    error = math.hypot(float(errors[first]), _CALIBRATION_SIGMA)
    if not grasped.distance <= reach + _CERTAINTY_SIGMAS * error:
        raise FitError(
            f"gripper '{grasped.gripper}' is {1e3 * grasped.distance:.0f} mm from the nearest particle, {first}: its "
            f"poses do not touch the cloth. Give the fingertips' poses, in the clouds' frame and by their clock. "
            f"{_remedy(grasped)}"
        )
    for candidate in free_particles:
        separation = float(np.linalg.norm(positions[candidate] - positions[first]))
        # Distance of the gripper from the bisecting plane of the two particles, positive on the first one's side.
        margin = 0.0
        if separation > 0.0:
            square = float(positions[candidate] @ positions[candidate])
            margin = (square - grasped.distance**2) / (2.0 * separation)
        uncertainty = math.hypot(error, 0.5 * float(errors[candidate]) if math.isfinite(errors[candidate]) else 0.0)
        if margin < _CERTAINTY_SIGMAS * uncertainty:
            raise FitError(
                f"gripper '{grasped.gripper}' may hold particle {first} or {candidate}: by the clouds they are "
                f"{1e3 * grasped.distance:.0f} and {1e3 * float(np.linalg.norm(positions[candidate])):.0f} mm from its "
                f"origin, with an uncertainty of {1e3 * uncertainty:.1f} mm. {_remedy(grasped)}"
            )


def _remedy(grasped: GraspedParticles) -> str:
    return f"Name the particles: --held {grasped.gripper}={grasped.particles[0]}"


def _mean_local_positions(clouds: Sequence[Array], poses: Sequence[Sequence[float]]) -> _LocalPositions:
    """Return mean positions in the gripper's frame, and the noise between successive clouds."""
    local_clouds = []
    for cloud, pose in zip(clouds, poses, strict=True):
        # World vector d in the gripper's frame: R' d.
        local_clouds.append((cloud - np.asarray(pose[:3])) @ np.array(rotation_matrix(np.asarray(pose[3:]))))
    stack = np.array(local_clouds)
    seen = np.isfinite(stack).all(axis=2)
    count = seen.sum(axis=0)
    sums = np.where(seen[..., None], stack, 0.0).sum(axis=0)
    mean = np.where(count[:, None] > 0, sums / np.maximum(count, 1)[:, None], np.nan)
    steps = np.diff(stack, axis=0)
    steps = np.abs(steps[np.isfinite(steps)])
    # 0.6745 is the median absolute value of the standard normal distribution. One cloud gives no noise estimate.
    noise = float(np.median(steps)) / (0.6745 * math.sqrt(2.0)) if steps.size else 0.0
    return _LocalPositions(mean=mean, n_seen=count, noise=noise)


def _rough_positions(rest_shape: Array, local_positions: _LocalPositions) -> Array:
    """Return rough positions in the gripper's frame [m]; a hidden particle gets that of the nearest visible one."""
    from scipy.spatial import cKDTree

    seen = np.flatnonzero(local_positions.n_seen)
    if not seen.size:
        return np.full(rest_shape.shape, np.nan)
    hidden = np.flatnonzero(local_positions.n_seen == 0)
    rough = local_positions.mean.copy()
    if hidden.size:
        _, nearest = cKDTree(rest_shape[seen]).query(rest_shape[hidden])
        rough[hidden] = local_positions.mean[seen[np.asarray(nearest)]]
    return rough


def _extrapolate_position(rest_shape: Array, local_positions: _LocalPositions, particle: int) -> tuple[Array, float]:
    """Return a particle's position in the gripper's frame and its deviation [m], from neighbours if it is hidden."""
    noise = local_positions.noise
    if local_positions.n_seen[particle]:
        return local_positions.mean[particle], noise / math.sqrt(local_positions.n_seen[particle])
    seen = np.flatnonzero(local_positions.n_seen)
    distances = np.linalg.norm(rest_shape[seen] - rest_shape[particle], axis=1)
    nearest = np.argsort(distances, kind="stable")[:_N_NEIGHBOURS]
    seen, distances = seen[nearest], distances[nearest]
    weights = np.sqrt(local_positions.n_seen[seen]) / np.maximum(distances, 1e-9)
    design = np.column_stack([np.ones(len(seen)), rest_shape[seen] - rest_shape[particle]])
    # A flat rest shape has a column of zeros. The pseudo-inverse omits it.
    inverse = np.linalg.pinv(design * weights[:, None], rcond=1e-6) * weights
    coefficients = inverse @ local_positions.mean[seen]
    residuals = local_positions.mean[seen] - design @ coefficients
    n_free = max(len(seen) - int(np.linalg.matrix_rank(design, tol=1e-9)), 1)
    # Residuals of the linear map are noise and curvature, and both affect the extrapolated position.
    residual_variance = float(np.square(residuals).sum()) / (3 * n_free)
    variance = np.maximum(residual_variance, noise**2 / local_positions.n_seen[seen])
    return coefficients[0], float(np.sqrt((np.square(inverse[0]) * variance).sum()))


def extrapolate_cloud(rest_shape: Array, cloud: Array) -> Array:
    """Return a cloud's positions [m], (n, 3), with hidden particles (NaN) extrapolated from their neighbours."""
    seen = np.isfinite(cloud).all(axis=1)
    local_positions = _LocalPositions(mean=cloud, n_seen=np.asarray(seen, dtype=np.int64), noise=0.0)
    positions = cloud.copy()
    for particle in np.flatnonzero(~seen).tolist():
        positions[particle] = _extrapolate_position(rest_shape, local_positions, particle)[0]
    return positions


def particles_within(rest_shape: Array, first: int, radius: float) -> tuple[int, ...]:
    """Return the indices of a particle and of those within a radius [m] of it in the rest shape, the nearest first."""
    distances = np.linalg.norm(rest_shape - rest_shape[first], axis=1)
    order = np.argsort(distances, kind="stable")
    return tuple(int(k) for k in order if distances[k] <= radius)


def _spacing(rest_shape: Array, particle: int) -> float:
    """Return the distance of a particle to the nearest other one in the rest shape [m]."""
    distances = np.linalg.norm(rest_shape - rest_shape[particle], axis=1)
    distances[particle] = np.inf
    return float(distances.min())


def _particle_name(scene: Scene, particle: int) -> str:
    return next((f"{particle} ({name})" for name, corner in _corners(scene) if corner == particle), str(particle))


def _corners(scene: Scene) -> Iterator[tuple[str, int]]:
    if isinstance(scene.sheet, GridSheet):
        for row in ("top", "bottom"):
            for column in ("left", "right"):
                yield f"{row}_{column}", int(scene.sheet.edge(f"{row}_{column}")[0])


def parse_all_grasped(scene: Scene, texts: Mapping[str, str]) -> dict[str, tuple[int, ...]]:
    """Return particle indices by gripper from texts such as ``12,13`` or ``top_left``. Raises FitError.

    Raises:
        FitError: if a gripper or particle is unknown, or two grippers hold the same particle.
    """
    unknown = [name for name in texts if name not in scene.gripper_names]
    if unknown:
        known_names = ", ".join(scene.gripper_names) or "none"
        raise FitError(f"--held names '{unknown[0]}'; the scene's grippers are {known_names}")
    pinching = [name for name in texts if scene.pinches(name)]
    if pinching:
        raise FitError(f"--held names '{pinching[0]}', a pinching gripper; its pads hold the cloth between them")
    particles = {name: parse_grasped(scene, name, text) for name, text in texts.items()}
    _check_no_common_particle(particles)
    return particles


def check_no_common_particle(grippers: Sequence[GraspedParticles]) -> None:
    """Raise FitError, with both names, if two grippers hold the same particle."""
    _check_no_common_particle({gripper.gripper: gripper.particles for gripper in grippers})


def _check_no_common_particle(particles_by_gripper: Mapping[str, Sequence[int]]) -> None:
    gripper_of: dict[int, str] = {}
    for name, particles in particles_by_gripper.items():
        for particle in particles:
            if gripper_of.setdefault(particle, name) != name:
                cause = f"grippers '{gripper_of[particle]}' and '{name}' would both hold particle {particle}"
                raise FitError(f"{cause}; name the particles of each: --held {name}=PARTICLE")
