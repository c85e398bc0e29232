"""How the kernels of the experts' planning are compiled."""

from __future__ import annotations

from mjhab.core.kernels.jit import compiler

KERNEL_MODULES = (
    "core.kernels.box_gaps",
    "experts.jit",
    "experts.arm.frame_kernels",
    "experts.arm.gentle",
    "experts.arm.ik_kernels",
    "experts.arm.sphere_gaps",
    "experts.arm.step_kernels",
    "experts.base.follower",
    "experts.base.navigation",
    "experts.base.pilot",
    "robots.kinematics",
)
"""Modules whose code or constants go into kernels."""
kernel = compiler(*KERNEL_MODULES)
inline = compiler(*KERNEL_MODULES, forceinline=True)
"""For helpers of inner loops: a call would copy every array descriptor it is given."""
