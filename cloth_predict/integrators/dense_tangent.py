"""The derivative of a step as a matrix."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from cloth_predict.types import FloatArray


@dataclass(frozen=True)
class DenseTangent:
    """A derivative given as a matrix, and a way to that by the inputs if any; see `Tangent`."""

    step_jac: FloatArray
    input_jac: Callable[[], FloatArray] | None = None

    def push(self, columns: FloatArray) -> FloatArray:
        """Return F C."""
        return self.step_jac @ columns

    def pull(self, rows: FloatArray) -> FloatArray:
        """Return W F."""
        return rows @ self.step_jac

    def sandwich(self, cov: FloatArray) -> FloatArray:
        """Return F P F'."""
        return self.step_jac @ cov @ self.step_jac.T

    def drive(self, inputs: FloatArray) -> FloatArray:
        """Change of the state after the step with its inputs."""
        if self.input_jac is None:
            raise ValueError('the derivative by the inputs was not given')
        return self.input_jac() @ inputs
