"""numba decorators of the experts' planning kernels."""

from __future__ import annotations

from mjhab.core.kernels.jit import compiler

KERNEL_MODULES = (
    "core.kernels.box_gaps",
    "experts.jit",
    "experts.arm.frame_kernels",
    "experts.base.limits",
    "experts.arm.ik_kernels",
    "experts.arm.sphere_gaps",
    "experts.arm.step_kernels",
    "experts.base.follower",
    "robots.damped_steps",
)
"""Modules whose code or constants are compiled into kernels: a change in one of them recompiles the kernels."""
kernel = compiler(*KERNEL_MODULES)
inline = compiler(*KERNEL_MODULES, forceinline=True)
"""Decorator for helpers of inner loops: without inlining, every call would copy the descriptors of its arrays."""
