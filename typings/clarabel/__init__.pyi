# Clarabel is a compiled module without type information: what design/cone_solver.py uses of it, as of 0.10.
from collections.abc import Sequence
from typing import Any

from numpy.typing import NDArray
from scipy import sparse

class DefaultSettings:
    verbose: bool
    def __setattr__(self, name: str, value: Any) -> None: ...

class SolverStatus: ...

class DefaultSolution:
    x: list[float]
    status: SolverStatus

class ZeroConeT:
    def __init__(self, dim: int) -> None: ...

class NonnegativeConeT:
    def __init__(self, dim: int) -> None: ...

class SecondOrderConeT:
    def __init__(self, dim: int) -> None: ...

class PSDTriangleConeT:
    def __init__(self, dim: int) -> None: ...

class DefaultSolver:
    def __init__(
        self,
        P: sparse.csc_matrix,
        q: NDArray[Any],
        A: sparse.csc_matrix,
        b: NDArray[Any],
        cones: Sequence[Any],
        settings: DefaultSettings,
    ) -> None: ...
    def solve(self) -> DefaultSolution: ...
