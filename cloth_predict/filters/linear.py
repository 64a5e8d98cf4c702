"""The linear algebra of Gaussian conditioning; the only Cholesky of a covariance is here."""

from __future__ import annotations

import numpy as np
from scipy.linalg import blas, lapack

from cloth_predict.types import FloatArray, Gaussian, Innovation, IntArray, Tangent


def propagate(cov: FloatArray, tangent: Tangent, noise: FloatArray) -> FloatArray:
    """Covariance after a step: F (P + N/2) F' + N/2, shape (dim_x, dim_x).

    `noise`, shape (dim_x,), is dt times the spectral density. Half of it acts before the step and
    half after (trapezoid rule for the integral of the noise), so that noise on the velocities
    reaches the positions.
    """
    half = 0.5 * noise
    end = tangent.push(tangent.push(spread(cov, half)).T)  # F (F P)' = F P F', as P is symmetric
    return symmetric(spread(end, half))


def spread(cov: FloatArray, variance: FloatArray) -> FloatArray:
    """Covariance with an independent noise of `variance`, shape (dim_x,), on each state."""
    wider = cov.copy()
    wider.flat[:: len(variance) + 1] += variance
    return wider


def condition(
    belief: Gaussian, jac: FloatArray | IntArray, noise: FloatArray, residual: FloatArray
) -> tuple[Gaussian, Innovation]:
    """Condition a belief on a linear measurement (Gomes 2016, eq. 6.6).

    With S = H P H' + R = L L' and W = L^-1 H P the gain is K = W' L^-1, and the covariance
    P - K S K' = P - W' W is symmetric by construction. `jac` of integers selects rows. Raises
    FloatingPointError where S is not positive definite.
    """
    selects = np.issubdtype(jac.dtype, np.integer)
    cross = belief.cov[jac] if selects else jac @ belief.cov
    innovation_cov = cross[:, jac] if selects else cross @ jac.T
    if not residual.size:  # nothing seen, nothing learnt; LAPACK complains of empty systems
        return belief, Innovation(residual, innovation_cov, 0.0)
    innovation_cov = innovation_cov + (np.diag(noise) if noise.ndim == 1 else noise)
    lower = root(innovation_cov, 'innovation covariance')
    # W' = (H P)' L'^-1 in place: the transpose of an array of rows is one of columns to BLAS
    gain_root = blas.dtrsm(1.0, lower, cross.T, side=1, lower=1, trans_a=1, overwrite_b=1).T
    white_residual, _ = lapack.dtrtrs(lower, residual, lower=1)
    mean = belief.mean + gain_root.T @ white_residual
    cov = symmetric(belief.cov - gain_root.T @ gain_root)
    nis = float(white_residual @ white_residual)
    return Gaussian(mean, cov), Innovation(residual, innovation_cov, nis)


def root(cov: FloatArray, name: str) -> FloatArray:
    """Lower triangular L of cov = L L', shape (m, m).

    Raises FloatingPointError that says `name` where cov is not positive definite.
    """
    lower, failed = lapack.dpotrf(cov, lower=1)
    if failed or not np.isfinite(lower[-1, -1]):  # a NaN passes through LAPACK to the last pivot
        raise FloatingPointError(f'the {name} is not positive definite')
    return np.asarray(lower)


def nearest_positive_definite(cov: FloatArray) -> FloatArray:
    """Nearest symmetric matrix without negative eigenvalues, but for rounding (Higham 1988).

    Eigenvalues are raised to 1e-12 of the largest one, so that the result has a Cholesky root.
    """
    values, vectors = np.linalg.eigh(symmetric(cov))
    return symmetric((vectors * np.maximum(values, 1e-12 * values[-1])) @ vectors.T)


def of_groups(left: FloatArray, right: FloatArray, rows: IntArray) -> FloatArray:
    """Products L R' within k groups of m rows, both of shape (k m, dim_x), shape (k, m, m)."""
    groups = (*rows.shape, -1)
    return np.asarray(left.reshape(groups) @ right.reshape(groups).transpose(0, 2, 1))


def symmetric(matrix: FloatArray) -> FloatArray:
    """Symmetric part of a matrix, or of each of (..., m, m), symmetric but for rounding."""
    return 0.5 * (matrix + matrix.swapaxes(-1, -2))
