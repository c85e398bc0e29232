"""Compilation of homes to MjModels, with a cache on disk; the key is a hash of all inputs and of the arithmetic."""

from __future__ import annotations

import hashlib
from pathlib import Path

import mujoco

from mjhab.core.arithmetic.digest import arithmetic_digest
from mjhab.core.errors import fault
from mjhab.core.files.cache import cache_dir, read_cached, write_cached
from mjhab.core.files.code_digest import code_digest
from mjhab.core.names import below
from mjhab.layout.joints import give_stopped_weight
from mjhab.layout.layout import Layout
from mjhab.layout.model_spec import build_spec
from mjhab.layout.search_trees import rebuild_trees
from mjhab.scenes.spec import PUBLISHED_DYNAMICS, Home


def home_hash(layout: Layout, home: Home) -> str:
    """Return a hash of what the compiled model of a home is made of; it names a home on every machine.

    It covers home, layout, robot, assets, MuJoCo's version and the source of the code that builds models. Models of
    equal hashes are equal on one machine; the last bits may differ where `arithmetic_digest` does. It is cached in the
    layout, with the home, so that the home's id is not reused.
    """
    return layout.derived.get(
        # With the home in the value: an id may be given again once its object is gone.
        ("hash", id(home)),
        lambda: (home, _home_hash(layout, home)),
    )[1]


def _home_hash(layout: Layout, home: Home) -> str:
    digest = hashlib.sha256(
        mujoco.__version__.encode()
        + code_digest("core.arithmetic", "scenes", "robots.model", "layout")
    )
    digest.update(layout.robot.digest)
    digest.update(
        repr(
            (
                home,
                layout.roster,
                layout.prop_slots,
                layout.num_walls,
                layout.joint_dynamics,
                sorted(layout.stopped_links),
            )
        ).encode()
    )
    # The same for all homes of a layout; hashing meshes takes longest.
    digest.update(layout.derived.get("pieces", lambda: _pieces(layout)))
    return digest.hexdigest()[:24]


def _pieces(layout: Layout) -> bytes:
    """Everything that the homes of a layout are made of, the same for all of them."""
    pack = layout.pack
    furniture = (sorted(pack.props.items()), sorted(pack.articulations.items()))
    told = repr((*furniture, layout.objects)).encode()
    return told + b"".join(
        name.encode() + pack.meshes[name].vertices.tobytes()  # type: ignore[attr-defined]
        # Only vertices: collision takes their convex hull, and faces are drawn from elsewhere.
        for name in sorted(pack.meshes)
    )


def model_path(layout: Layout, home: Home) -> Path:
    """Return the path in the disk cache of a home's compiled model, whether it exists or not."""
    made_of = home_hash(layout, home).encode()
    key = hashlib.sha256(made_of + arithmetic_digest()).hexdigest()[:24]
    return below(cache_dir() / "models", f"{home.name}-{key}.mjb")


def compile_home(layout: Layout, home: Home) -> mujoco.MjModel:
    """Return the MjModel of a home; reads it from the disk cache, or compiles and caches it.

    Raises:
        UsageError: MuJoCo refuses the home; the message names it.
    """
    path = model_path(layout, home)
    found = read_cached(path, _load)
    if found is None:
        try:
            model = build_spec(layout, home).compile()
            if layout.joint_dynamics == PUBLISHED_DYNAMICS:
                pieces = layout.pack.articulations.values()
                give_stopped_weight(model, pieces, layout.stopped_links)
            # Before it is saved, so that the file has the trees that searches take.
            rebuild_trees(model)
        # What MuJoCo raises for a spec that it cannot compile.
        except ValueError as error:
            # MuJoCo's messages have several lines.
            reason = ", ".join(str(error).splitlines())
            raise fault(f"home {home.name!r}", f"does not compile: {reason}") from error
        # Saving drops the signature of a freshly compiled model: loading from the file makes all models equal.
        found = _load(
            write_cached(path, lambda file: mujoco.mj_saveModel(model, str(file), None))
        )
    return found


def _load(path: Path) -> mujoco.MjModel:
    # MuJoCo warns of a file that is not there.
    if not path.exists():
        raise FileNotFoundError(path)
    return mujoco.MjModel.from_binary_path(str(path))
