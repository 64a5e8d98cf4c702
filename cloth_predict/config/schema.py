"""The parameters: their defaults, meanings, units, and the values that they may take."""

from __future__ import annotations

from dataclasses import dataclass, field

from cloth_predict.config.body import BodyConfig
from cloth_predict.config.parameter import param
from cloth_predict.config.projector import ProjectorConfig
from cloth_predict.config.rest import RestConfig


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
    body: BodyConfig = field(default_factory=BodyConfig)
    anchors: AnchorsConfig = AnchorsConfig()
    force: ForceConfig = ForceConfig()
    wind: WindConfig = WindConfig()
    filter: FilterConfig = FilterConfig()
    association: AssociationConfig = AssociationConfig()
    limits: LimitsConfig = LimitsConfig()
    rest: RestConfig = field(default_factory=RestConfig)
    baseline: BaselineConfig = BaselineConfig()
    replay: ReplayConfig = ReplayConfig()
    projector: ProjectorConfig = field(default_factory=ProjectorConfig)
    live_check: LiveCheckConfig = LiveCheckConfig()

    @property
    def nodes_are_markers(self) -> bool:
        """Whether the published nodes of a body are its markers, in the order of their labels."""
        return self.model.is_body and self.body.mesh == 'markers' and not self.body.nodes

    @property
    def every_horizon(self) -> tuple[float, ...]:
        """What is predicted [s]: `horizon`, which the projector uses, then the further ones."""
        return (self.horizon, *(further for further in self.horizons if further != self.horizon))
