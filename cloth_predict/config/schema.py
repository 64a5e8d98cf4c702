"""The parameters: their defaults, meanings, units, and the values that they may take."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any


def param(
    default: Any,
    doc: str,
    unit: str = '',
    low: float | None = None,
    high: float | None = None,
    above: float | None = None,
    choices: tuple[str, ...] = (),
    length: int | None = None,
) -> Any:
    """Declare a parameter: default, meaning, unit, and the values that it may take."""
    limits = {
        'doc': doc,
        'unit': unit,
        'low': low,
        'high': high,
        'above': above,
        'choices': choices,
        'length': length,
    }
    return field(default=default, metadata=limits)


@dataclass(frozen=True)
class ModelConfig:
    """The model of the surface: masses and springs, or a deformable body (`body`)."""

    kind: str = param(
        'mass_spring',
        'a surface of masses, springs and dampers, or a closed body, of which of this group only '
        '`nodes`, `mass` and `gravity` count',
        choices=('mass_spring', 'superquadric'),
    )
    topology: str = param(
        'grid',
        'which nodes are joined: rows and columns, listed edges, or a triangulation at the start '
        '(its markers without labels are numbered as they come); that of a body is `closed`, and '
        'need not be said',
        choices=('grid', 'edges', 'delaunay', 'closed'),
    )
    rows: int = param(5, 'rows of nodes of a grid; a chain has 1', low=1)
    cols: int = param(4, 'columns of nodes of a grid', low=1)
    nodes: int = param(
        0,
        'number of nodes of `edges`, `delaunay` and `closed`; that of `labels` when left out',
        low=0,
    )
    edges: tuple[int, ...] = param(
        (), 'pairs of joined nodes of `edges`, one after the other: 0, 1, 1, 2, ...', low=0
    )
    refine: int = param(
        1,
        'cells of the model along each cell of a grid of markers, with nodes between them that '
        'nobody sees; needs `rest_length` dimensions',
        low=1,
    )
    width: float = param(0.51, 'from the first to the last column at rest', 'm', above=0)
    height: float = param(0.80, 'from the first to the last row at rest', 'm', above=0)
    rest_length: str = param(
        'dimensions',
        'rest lengths from width and height, from the distances measured in the first frame, or '
        'from their median over `calibration`',
        choices=('dimensions', 'measured', 'calibrated'),
    )
    calibration: float = param(
        2.0, 'time before the start over which `calibrated` measures', 's', above=0
    )
    prestretch: float = param(
        0.0,
        'share by which the springs are shorter at rest than `rest_length` says: what hangs or is '
        'held taut was under tension there, and tension keeps it straight',
        low=0,
        high=0.9,
    )
    mass: float = param(
        0.34, 'mass of the whole surface, shared evenly by the nodes', 'kg', above=0
    )
    stiffness_structural: float = param(60.0, 'springs to the 4 neighbours', 'N/m', low=0)
    stiffness_shear: float = param(60.0, 'springs to the 4 diagonal neighbours', 'N/m', low=0)
    stiffness_flexion: float = param(60.0, 'springs to the nodes 2 away', 'N/m', low=0)
    damping: float = param(
        0.1,
        'damper of every spring; shear and flexion springs without stiffness have none',
        'N s/m',
        low=0,
    )
    compression: float = param(
        1.0, 'share of its stiffness that a compressed spring has; cloth buckles', low=0, high=1
    )
    compression_flexion: float = param(
        -1.0,
        'the same of the springs to the nodes 2 away; below 0 it is `compression`',
        low=-1,
        high=1,
    )
    gravity: tuple[float, ...] = param(
        (0.0, -9.81, 0.0), 'gravity in the mocap frame', 'm/s^2', length=3
    )
    springs: tuple[float, ...] = param(
        (),
        'stiffness of each spring in place of `stiffness_*`: of the structural, the shear, then '
        'the flexion springs; not for `delaunay`',
        'N/m',
        low=0,
    )
    dampers: tuple[float, ...] = param(
        (), 'damper of each spring, in the same order, in place of `damping`', 'N s/m', low=0
    )
    masses: tuple[float, ...] = param(
        (), 'mass of each node of the model, row by row, in place of `mass`', 'kg', above=0
    )
    loads: tuple[float, ...] = param(
        (),
        'factor of gravity at each node of the model (Gomes 2016, eq. 5.15); 1 when left out',
        low=0,
    )

    @property
    def count(self) -> int:
        """Number of nodes."""
        return self.rows * self.cols if self.topology == 'grid' else self.nodes

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of a published surface: (1, nodes) where there are none."""
        return (self.rows, self.cols) if self.topology == 'grid' else (1, self.nodes)

    @property
    def mesh(self) -> tuple[int, int]:
        """Rows and columns of the mesh of a grid: those of the markers, and those between."""
        return (self.rows - 1) * self.refine + 1, (self.cols - 1) * self.refine + 1

    @property
    def mesh_nodes(self) -> int:
        """Number of nodes of the model: those of the markers, and those between."""
        return self.mesh[0] * self.mesh[1] if self.topology == 'grid' else self.nodes

    @property
    def name(self) -> str:
        """The size in words, for errors."""
        if self.topology == 'grid':
            return f'{self.rows} x {self.cols} = {self.count} nodes'
        return f'{self.count} nodes'

    @property
    def counted_by(self) -> str:
        """The parameters that give the number of nodes."""
        return 'model.rows x model.cols' if self.topology == 'grid' else 'model.nodes'

    @property
    def is_body(self) -> bool:
        """Whether it is a closed body, and no surface of springs."""
        return self.kind == 'superquadric'


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


@dataclass(frozen=True)
class AnchorsConfig:
    """Nodes that the surroundings move; inputs of the model, not states."""

    nodes: tuple[int, ...] = param((), 'indices of the driven nodes, row by row from 0', low=0)
    motion: str = param(
        'fixed',
        'how a driven node moves between and beyond its measurements',
        choices=('fixed', 'constant_velocity', 'constant_acceleration', 'swing'),
    )
    decay: float = param(
        3.5,
        'swing, of a hand: how fast the acceleration is forgotten',
        '1/s',
        low=0,
        high=1000,
    )
    restoring: float = param(
        15.0,
        'swing: how strongly the velocity is drawn back to zero, the square of the angular '
        'frequency; 0 is the model of Singer',
        '1/s^2',
        low=0,
        high=1e6,
    )
    process_noise: float = param(
        0.0,
        'spectral density of the white noise that drives the motion (0 for fixed)',
        'm^2/s^(2k+1)',
        low=0,
    )


@dataclass(frozen=True)
class ForceConfig:
    """The force that the model does not know (wind, touch), as a state of the filter."""

    kind: str = param(
        'none',
        'one force per free node as a state: rough, smooth, or none',
        choices=('none', 'ornstein_uhlenbeck', 'matern'),
    )
    sigma: float = param(0.1, 'standard deviation of each component of the force', 'N', above=0)
    tau: float = param(0.3, 'time over which the force forgets', 's', above=0)
    initial: tuple[float, ...] = param(
        (0.0, 0.0, 0.0),
        'what the force of each node is believed to be at the start',
        'N',
        length=3,
    )


@dataclass(frozen=True)
class WindConfig:
    """Moving air as a state of the filter: it presses along the normals, and damps the motion.

    Forces are those on the area of one marker (a cell of a grid).
    """

    kind: str = param(
        'none',
        'gusts at each free marker and a wind common to all; for surfaces, not for chains',
        choices=('none', 'normal'),
    )
    sigma: float = param(0.12, 'standard deviation of a gust at one marker', 'N', above=0)
    tau: float = param(0.23, 'time over which a gust forgets', 's', above=0)
    length: float = param(0.2, 'distance over which gusts are alike', 'm', above=0)
    independent: float = param(
        0.17,
        "share of a gust's variance that each marker has for itself",
        above=0,
        high=1,
    )
    common_sigma: float = param(
        0.2, 'standard deviation of each component of the common wind', 'N', above=0
    )
    common_tau: float = param(1.0, 'time over which the common wind forgets', 's', above=0)
    drag: float = param(
        0.17, 'what moving at 1 m/s along its normal costs a marker', 'N s/m', low=0
    )


@dataclass(frozen=True)
class FilterConfig:
    """The estimator."""

    kind: str = param(
        'ekf',
        'estimator; ukf and ckf cost some hundred times the ekf; a body has ekf, ukf, ckf and '
        'decoupled',
        choices=(
            'ekf',
            'ukf',
            'ckf',
            'least_squares',
            'recursive_least_squares',
            'gomes2016',
            'fixed_gain',
            'reduced_rank',
            'decoupled',
        ),
    )
    integrator: str = param(
        'implicit_euler',
        'step in time of a surface of springs',
        choices=('euler', 'rk4', 'implicit_euler'),
    )
    max_step: float = param(
        0.01, 'longest step from frame to frame; a longer interval is split', 's', low=1e-4
    )
    predict_step: float = param(
        0.02, 'longest step of a prediction; a longer horizon is split', 's', low=1e-4
    )
    process_noise: float = param(
        1.0, 'spectral density of the unknown acceleration of each free node', 'm^2/s^3', low=0
    )
    measurement_noise: float = param(
        3e-4, 'standard deviation of each coordinate of a marker', 'm', above=0
    )
    initial_velocity: float = param(
        0.5, 'standard deviation of the velocity at the start', 'm/s', low=0
    )
    hold: int = param(
        1,
        'ekf: frames that one covariance serves while the same markers stay in view; 1 is exact',
        low=1,
        high=10,
    )
    ukf_alpha: float = param(
        0.1,
        'ukf: reach of the sigma points, in sqrt(states) standard deviations; where it is small, '
        'rounding can cost the covariance its sign',
        low=1e-4,
        high=1,
    )
    window: float = param(
        0.1,
        'least_squares: time over which the state is fitted to all measurements; its cost grows '
        'with the number of frames in it',
        's',
        above=0,
        high=1,
    )
    forgetting: float = param(
        0.03,
        'recursive_least_squares: time constant of the weight of past measurements',
        's',
        above=0,
    )
    rank: int = param(
        4,
        'reduced_rank: spatial modes with a full covariance; the rest has one for each node',
        low=1,
    )
    max_gap: float = param(
        1.0, 'interval between frames after which the filter starts anew', 's', above=0
    )
    max_backstep: float = param(
        0.5,
        'a stamp this far back is a new start (a looped bag), a nearer one a late frame',
        's',
        above=0,
    )
    rewind: float = param(
        0.05,
        'a late frame that is at most this old is put in its place, and those after it are taken '
        'again; 0 drops it',
        's',
        low=0,
    )


@dataclass(frozen=True)
class AssociationConfig:
    """Which marker is which node."""

    check_labels: bool = param(
        True, 'put swapped labels right, and hide markers that are at no node'
    )
    gate: float = param(
        0.999999,
        'share of the true markers that is inside the gate of its node',
        above=0,
        high=0.999999999,
    )
    slack: float = param(
        0.003,
        "standard deviation of a node's position that the filter does not know of, in the gate",
        'm',
        low=0,
    )
    drift: float = param(
        0.02,
        'how fast this grows while the node is not seen, until the gate reaches its neighbours',
        'm/s',
        low=0,
    )
    patience: float = param(
        0.5,
        'time after which the surface starts anew where most of its markers are at no node',
        's',
        above=0,
    )


@dataclass(frozen=True)
class LimitsConfig:
    """From where on a prediction is doubtful, and from where on there is none."""

    min_visible: int = param(3, 'warn of fewer markers than this: three fix a rigid motion', low=0)
    sigma_warn: float = param(
        0.025,
        'warn of a larger sigma of a prediction (root mean square over the free nodes)',
        'm',
        above=0,
    )
    sigma_error: float = param(
        0.05, 'make no prediction whose sigma would be larger than this', 'm', above=0
    )


@dataclass(frozen=True)
class BaselineConfig:
    """The kinematic filters that `evaluate` compares with."""

    cv_noise: float = param(
        30.0, 'constant velocity: spectral density of the acceleration', 'm^2/s^3', above=0
    )
    ca_noise: float = param(
        3000.0, 'constant acceleration: spectral density of the jerk', 'm^2/s^5', above=0
    )


@dataclass(frozen=True)
class ReplayConfig:
    """The replay node."""

    path: str = param('', 'bag (folder or .mcap) or Motive .csv to replay')
    rate: float = param(1.0, 'speed of replay', 'x', above=0, high=1000)
    loop: bool = param(False, 'start again at the end')
    start: float = param(0.0, 'offset into the recording at which to start', 's', low=0)
    clock: bool = param(True, 'publish /clock')
    live: bool = param(
        False,
        'stamp the frames with the time at which they are due, by the clock of the node, not with '
        'that of the recording, and publish no /clock: as a mocap system would',
    )
    subscribers: int = param(1, 'subscribers of markers to wait for before the first frame', low=0)
    timeout: float = param(15.0, 'longest wait for them', 's', low=0)
    drop: float = param(0.0, 'share of markers to leave out at random', low=0, high=1)
    jitter: float = param(0.0, 'standard deviation of a random delay of each frame', 's', low=0)
    seed: int = param(0, 'seed of the drops and delays', low=0)


@dataclass(frozen=True)
class ProjectorConfig:
    """The projector: a pinhole (Gomes 2016, eq. 2.8-2.10) with a lens, that draws line by line.

    Pixel centres are at whole numbers, as in OpenCV: the frame reaches from -0.5 to width - 0.5.
    """

    calibration: str = param(
        '',
        'file of OpenCV or `camera_info` (YAML); what it holds takes the place of the resolution, '
        'focal lengths, skew, principal point, distortion, rotation and translation given here',
    )
    width: int = param(1280, 'resolution across', 'px', low=1)
    height: int = param(720, 'resolution down', 'px', low=1)
    alpha: float = param(1400.0, 'focal length across', 'px', above=0)
    beta: float = param(1400.0, 'focal length down', 'px', above=0)
    gamma: float = param(0.0, 'skew', 'px')
    u0: float = param(640.0, 'principal point across', 'px')
    v0: float = param(360.0, 'principal point down', 'px')
    distortion: tuple[float, ...] = param(
        (),
        'k1, k2, p1, p2, then none, k3, or k3 to k6 of the model of OpenCV; none without a lens',
    )
    rotation: tuple[float, ...] = param(
        (1.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0, 0.0, -1.0),
        'rotation from the mocap frame to the projector (x right, y down, z out), row by row',
        length=9,
    )
    translation: tuple[float, ...] = param(
        (-0.255, 1.1, 2.2), 'translation from the mocap frame to the projector', 'm', length=3
    )
    throw: str = param(
        'front',
        'what the projector does to its picture by itself: nothing, mirror it for a screen lit '
        'from behind, turn it by 180 degrees where it hangs from a ceiling, or both',
        choices=('front', 'rear', 'ceiling', 'ceiling_rear'),
    )
    fps: float = param(60.0, 'frames drawn per second', 'Hz', above=0, high=1e5)
    scan: str = param(
        'progressive',
        'line by line; every second line and then the others; one colour of the whole frame '
        'after the other; or the whole frame at once',
        choices=('progressive', 'interlaced', 'colour_sequential', 'global'),
    )
    direction: str = param(
        'down',
        'where the beam goes from line to line: lines are rows, or columns',
        choices=('down', 'up', 'right', 'left'),
    )
    blanking: float = param(
        0.0,
        'share of the time of a field in which nothing is lit, after its last line',
        low=0,
        high=0.99,
    )
    colours: int = param(3, 'colour_sequential: fields of a frame', low=1, high=16)
    motion: str = param(
        'constant_acceleration',
        'how a vertex moves while the frame is drawn: by the velocity alone (Gomes 2016, '
        'eq. 6.23), with the acceleration, or as the model goes on from the start of the frame '
        'to its end',
        choices=('constant_velocity', 'constant_acceleration', 'model'),
    )
    max_row_error_px: float = param(
        0.1,
        'largest error of a vertex that is interpolated between two key rows of '
        '`projector/scanlines`',
        'px',
        low=1e-3,
    )
    mirrored: bool = param(
        False, 'the side that is lit is that on which the texture is mirrored: turn it round'
    )
    vsync: str = param(
        'period',
        'with `horizon_mode: vsync`: vsyncs at `vsync_phase` and then every 1 / `fps`, or at the '
        'phase of those that the topic `/vsync` (builtin_interfaces/Time) tells',
        choices=('period', 'topic'),
    )
    vsync_phase: float = param(0.0, 'time of one vsync, by the clock of the nodes', 's')
    delay: float = param(
        0.02,
        'from the vsync (or, without it, the arrival of a prediction) to the first line of the '
        'frame drawn from it: what the renderer and the projector take',
        's',
        low=0,
        high=1,
    )
    lead: float = param(
        0.004, 'how long before the vsync the warped vertices are published', 's', low=0, high=0.1
    )
    fallback: str = param(
        'hold',
        'what is shown while there is no safe prediction: the last safe one, or nothing',
        choices=('hold', 'blank'),
    )
    max_sigma: float = param(
        0.05, 'a prediction is not safe with a sigma above this at any vertex', 'm', above=0
    )
    max_age: float = param(
        0.25,
        'nor is there a safe one this long after the markers that it is made of',
        's',
        above=0,
    )
    max_speed: float = param(
        5000.0,
        'how fast a vertex may move over the frame when it catches up after a hold',
        'px/s',
        above=0,
    )
    warp_map: bool = param(
        False,
        'publish `projector/warp_map`, the texture coordinate of every pixel; takes a core of its '
        'own',
    )


@dataclass(frozen=True)
class LiveCheckConfig:
    """The check of the published predictions against the markers that arrive later."""

    window: float = param(10.0, 'time over which errors are summed up', 's', low=1, high=600)


@dataclass(frozen=True)
class Config:
    """Everything: one file serves all nodes and the command line."""

    horizon: float = param(0.1, 'how far ahead to predict (Ts)', 's', low=0, high=10)
    horizons: tuple[float, ...] = param(
        (), 'further horizons, each published on a topic of its own', 's', low=0.001, high=10
    )
    horizon_mode: str = param(
        'fixed',
        'auto: `horizon` only at the start, then the measured delay from capture to publication '
        'plus `projector.delay`; vsync: to the start of the frame that the projector asks for',
        choices=('fixed', 'auto', 'vsync'),
    )
    frame: str = param('mocap', 'frame_id of the markers')
    labels: tuple[str, ...] = param(
        (), 'labels of the markers to use, in node order; all of the recording when left out'
    )
    model: ModelConfig = ModelConfig()
    body: BodyConfig = BodyConfig()
    anchors: AnchorsConfig = AnchorsConfig()
    force: ForceConfig = ForceConfig()
    wind: WindConfig = WindConfig()
    filter: FilterConfig = FilterConfig()
    association: AssociationConfig = AssociationConfig()
    limits: LimitsConfig = LimitsConfig()
    baseline: BaselineConfig = BaselineConfig()
    replay: ReplayConfig = ReplayConfig()
    projector: ProjectorConfig = ProjectorConfig()
    live_check: LiveCheckConfig = LiveCheckConfig()

    @property
    def nodes_are_markers(self) -> bool:
        """Whether the published nodes of a body are its markers, in the order of their labels."""
        return self.model.is_body and self.body.mesh == 'markers' and not self.body.nodes

    @property
    def every_horizon(self) -> tuple[float, ...]:
        """What is predicted [s]: `horizon`, which the projector uses, then the further ones."""
        return (self.horizon, *(further for further in self.horizons if further != self.horizon))
