"""The projector as an inverse camera (Gomes 2016, section 2.2.2)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cloth_predict.config import ProjectorConfig
from cloth_predict.errors import ConfigError
from cloth_predict.types import FloatArray


@dataclass(frozen=True)
class Pinhole:
    """Projection matrix P = F [R t], shape (3, 4) (Gomes 2016, eq. 2.8-2.10)."""

    matrix: FloatArray

    @classmethod
    def from_config(cls, config: ProjectorConfig) -> Pinhole:
        """Build from the configuration. Raises ConfigError where the rotation is none."""
        intrinsic = np.array(
            [[config.alpha, config.gamma, config.u0], [0, config.beta, config.v0], [0, 0, 1]]
        )
        rotation = np.reshape(config.rotation, (3, 3))
        # a rotation typed with three digits is accepted, a mirrored or scaled one is not
        orthogonal = np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-2)
        if not orthogonal or np.linalg.det(rotation) < 0:
            raise ConfigError('projector.rotation: not a rotation matrix')
        return cls(intrinsic @ np.column_stack([rotation, config.translation]))

    def project(self, points: FloatArray) -> FloatArray:
        """Pixels u, v of points [m], shape (..., 3) to (..., 2); NaN behind the projector."""
        homogeneous = points @ self.matrix[:, :3].T + self.matrix[:, 3]
        depth = homogeneous[..., 2:]
        with np.errstate(divide='ignore', invalid='ignore'):
            pixels = homogeneous[..., :2] / depth
        return np.where(depth > 0, pixels, np.nan)
