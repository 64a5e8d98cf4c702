"""The parameters of the projector: defaults, meanings, units, and their range."""

from __future__ import annotations

from dataclasses import dataclass

from cloth_predict.config.parameter import param


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
