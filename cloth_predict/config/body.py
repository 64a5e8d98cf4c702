"""The parameters of a closed body: defaults, meanings, units, and their range."""

from __future__ import annotations

from dataclasses import dataclass

from cloth_predict.config.parameter import param


@dataclass(frozen=True)
class BodyConfig:
    """A closed body that deforms (`model.kind: superquadric`; Metaxas and Terzopoulos 1993)."""

    nodes: int = param(
        0,
        'nodes with a displacement of their own, between which the `model.nodes` that are '
        'published are interpolated; 0 is one for each of these',
        low=0,
    )
    mesh: str = param(
        'even',
        'where these are: spread evenly over the body, or at the markers of the first frame and '
        'evenly between them',
        choices=('even', 'markers'),
    )
    initial: tuple[float, ...] = param(
        (),
        'shape to start from: a0 (m), a1, a2, a3, e1, e2, t1, t2, b1 (m), b2, b3; an ellipsoid as '
        'large as the markers when left out',
    )
    fixed: tuple[str, ...] = param((), 'global parameters, by name, that keep this shape')
    local: bool = param(True, 'whether each node can be displaced from the global shape')
    w0: float = param(0.1, 'membrane: stiffness against displacement', 'N/m', low=0)
    w1: float = param(0.5, 'membrane: stiffness against its variation', 'N/m', above=0)
    alpha: float = param(1.0, 'damping by mass: how fast motion dies away', '1/s', low=0)
    beta: float = param(0.0, 'damping by stiffness of the displacements', 's', low=0)
    inertial: bool = param(
        False, 'centrifugal and Coriolis forces; the motion is linear without them'
    )
    reattach: float = param(
        0.5,
        'time after which markers without a label are attached to the nearest nodes anew',
        's',
        low=0,
    )
    coupling: str = param(
        'parts',
        'decoupled: covariances of translation, rotation and shape by themselves, or all three '
        'together; each node has one of its own',
        choices=('parts', 'pose'),
    )
    push: str = param(
        'none',
        'accelerations of the pose that last, as states: rough, smooth (with a rate that carries '
        'them on), or none',
        choices=('none', 'ornstein_uhlenbeck', 'matern'),
    )
    push_translation: float = param(
        3.0,
        'standard deviation of each component of that of the centre',
        'm/s^2',
        above=0,
    )
    push_rotation: float = param(
        5.0, 'the same of each component of the quaternion', '1/s^2', above=0
    )
    push_tau: float = param(0.2, 'time over which these accelerations forget', 's', above=0)
    translation_noise: float = param(
        0.01, 'spectral density of the white acceleration of the centre', 'm^2/s^3', low=0
    )
    rotation_noise: float = param(
        0.1, 'the same of each component of the quaternion', '1/s^3', low=0
    )
    global_noise: float = param(
        0.1, 'the same of each shape parameter, of lengths by the size of the body', '1/s^3', low=0
    )
    local_noise: float = param(0.01, 'the same of the displacement of each node', 'm^2/s^3', low=0)
