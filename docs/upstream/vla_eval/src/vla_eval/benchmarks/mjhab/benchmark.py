"""mjhab: rearranging a home with a mobile manipulator, low-level whole-body control at 20 Hz.

The class comes with the simulator, which tests it against this harness; see its docstring for the parameters.
"""

# Both packages are installed in the benchmark's own image.
# pyright: reportMissingImports=false
from mjhab.integrations.vla_eval import MjhabBenchmark

__all__ = ["MjhabBenchmark"]
