# type: ignore
# Kernels are written in Warp's language: Python syntax with other types, which type checkers reject.
"""Warp kernels for contact forces, taint, resets and teleports of the worlds of MuJoCo Warp.

The engine has one unordered contact list for all worlds, so that kernels over contacts read the world of each contact.
Kernels with a mask (``update``, ``fresh``) do not change the rows of other worlds.
"""

from __future__ import annotations

import warp as wp

# No gradients: their code would double what is compiled.
wp.set_module_options({"enable_backward": False})

CONSTRAINT_CONTACT = wp.constant(1)
"""Bit of ``contact.type``: the solver uses the contact; without it, it exists for a sensor only."""


@wp.kernel
def record_peak(count: wp.array[int], peak: wp.array[int]):
    """Keep the largest number of candidate geom pairs; the engine resets its own counter within a substep."""
    wp.atomic_max(peak, 0, count[0])


@wp.kernel
def clear_forces(
    update: wp.array[bool],
    link_net: wp.array2d[wp.vec3],
    hand_net: wp.array2d[wp.vec3],
    finger: wp.array3d[wp.vec3],
    touch: wp.array2d[bool],
    ee_contact: wp.array2d[bool],
    depth: wp.array[float],
):
    """Zero the contact results of the worlds of mask ``update``."""
    world = wp.tid()
    if not update[world]:
        return
    depth[world] = 0.0
    for k in range(link_net.shape[1]):
        link_net[world, k] = wp.vec3(0.0)
    for k in range(hand_net.shape[1]):
        hand_net[world, k] = wp.vec3(0.0)
    for t in range(touch.shape[1]):
        touch[world, t] = False
        ee_contact[world, t] = False
        finger[world, 0, t] = wp.vec3(0.0)
        finger[world, 1, t] = wp.vec3(0.0)


@wp.func
def normal_force(
    contact: int,
    world: int,
    njmax: int,
    frame: wp.array[wp.mat33],
    efc_address: wp.array2d[int],
    efc_force: wp.array2d[float],
) -> wp.vec3:
    """Return the normal force [N] of the first geom on the second in the world frame, without friction.

    With elliptic cones the first constraint row of a contact is its normal force; the first row of its frame is the
    direction of the normal.
    """
    row = efc_address[contact, 0]
    # No row was made for it, or it did not fit: then it has no force.
    if row < 0 or row >= njmax:
        return wp.vec3(0.0)
    return frame[contact][0] * efc_force[world, row]


@wp.kernel
def add_contacts(
    nacon: wp.array[int],
    dist: wp.array[float],
    frame: wp.array[wp.mat33],
    geom: wp.array[wp.vec2i],
    efc_address: wp.array2d[int],
    worldid: wp.array[int],
    kind: wp.array[int],
    efc_force: wp.array2d[float],
    njmax: int,
    geom_bodyid: wp.array[int],
    link_of: wp.array[int],
    finger_of: wp.array[int],
    target_of: wp.array[int],
    is_robot: wp.array[bool],
    is_end_effector: wp.array[bool],
    update: wp.array[bool],
    link_net: wp.array2d[wp.vec3],
    hand_net: wp.array2d[wp.vec3],
    finger: wp.array3d[wp.vec3],
    touch: wp.array2d[bool],
    ee_contact: wp.array2d[bool],
    depth: wp.array[float],
):
    """Sum the forces of the robot's contacts per force link, finger and (finger, target), and mark touched targets.

    One thread per contact. ``link_of``, ``finger_of`` and ``target_of`` map body ids to columns, -1 for none;
    ``depth`` becomes the least contact distance [m] of the robot (negative: penetration).
    """
    contact = wp.tid()
    # One thread per place in the list; most places are empty.
    if contact >= nacon[0] or (kind[contact] & CONSTRAINT_CONTACT) == 0:
        return
    world = worldid[contact]
    if not update[world]:
        return
    first = geom_bodyid[geom[contact][0]]
    second = geom_bodyid[geom[contact][1]]
    if not (is_robot[first] or is_robot[second]):
        return
    # Several threads may hold contacts of one world.
    wp.atomic_min(depth, world, dist[contact])
    force = normal_force(contact, world, njmax, frame, efc_address, efc_force)
    if is_robot[first] and target_of[second] >= 0:
        # Without an atomic operation: all threads write the same value.
        touch[world, target_of[second]] = True
    if is_robot[second] and target_of[first] >= 0:
        touch[world, target_of[first]] = True
    if is_end_effector[first] and target_of[second] >= 0:
        ee_contact[world, target_of[second]] = True
    if is_end_effector[second] and target_of[first] >= 0:
        ee_contact[world, target_of[first]] = True
    if link_of[first] >= 0:
        wp.atomic_add(link_net, world, link_of[first], -force)
    if link_of[second] >= 0:
        wp.atomic_add(link_net, world, link_of[second], force)
    if finger_of[first] >= 0:
        wp.atomic_add(hand_net, world, finger_of[first], -force)
    if finger_of[second] >= 0:
        wp.atomic_add(hand_net, world, finger_of[second], force)
    if finger_of[first] >= 0 and target_of[second] >= 0:
        wp.atomic_add(finger, world, finger_of[first], target_of[second], -force)
    if finger_of[second] >= 0 and target_of[first] >= 0:
        wp.atomic_add(finger, world, finger_of[second], target_of[first], force)


@wp.kernel
def finish_state(
    update: wp.array[bool],
    link_net: wp.array2d[wp.vec3],
    hand_net: wp.array2d[wp.vec3],
    tcp: int,
    tcp_root: int,
    xpos: wp.array2d[wp.vec3],
    subtree_com: wp.array2d[wp.vec3],
    cvel: wp.array2d[wp.spatial_vector],
    link_force: wp.array2d[float],
    finger_net: wp.array2d[float],
    tcp_vel: wp.array[wp.vec3],
):
    """Compute the norms of the net forces on links and fingers [N], and the velocity [m/s] of the tcp in the world."""
    world = wp.tid()
    if not update[world]:
        return
    for k in range(link_net.shape[1]):
        link_force[world, k] = wp.length(link_net[world, k])
    for k in range(hand_net.shape[1]):
        finger_net[world, k] = wp.length(hand_net[world, k])
    # ``cvel`` is (angular, linear) at the centre of mass of the whole kinematic tree.
    velocity = cvel[world, tcp]
    arm = xpos[world, tcp] - subtree_com[world, tcp_root]
    tcp_vel[world] = wp.spatial_bottom(velocity) + wp.cross(wp.spatial_top(velocity), arm)


@wp.kernel
def put_back_broken(
    before: wp.array2d[float],
    slept: wp.array2d[int],
    qpos: wp.array2d[float],
    qvel: wp.array2d[float],
    warmstart: wp.array2d[float],
    tree_asleep: wp.array2d[int],
    overflow: wp.array[int],
    broken: wp.array[bool],
):
    """Set worlds with NaN or infinite values back to qpos ``before`` and sleep state ``slept``, and mark them broken.

    Their velocity becomes zero. Without this, such a world would report contacts between all geoms and fill the contact
    buffer that all worlds share. Its overflow bits are cleared, because they do not mean that buffers are too small.
    """
    world = wp.tid()
    finite = wp.bool(True)
    for i in range(qpos.shape[1]):
        finite = finite and wp.isfinite(qpos[world, i])
    for i in range(qvel.shape[1]):
        finite = finite and wp.isfinite(qvel[world, i])
    if finite:
        return
    broken[world] = True
    overflow[world] = 0
    for i in range(qpos.shape[1]):
        qpos[world, i] = before[world, i]
    for i in range(qvel.shape[1]):
        qvel[world, i] = 0.0
        warmstart[world, i] = 0.0
    for tree in range(tree_asleep.shape[1]):
        tree_asleep[world, tree] = slept[world, tree]


@wp.kernel
def check_worlds(
    overflow: wp.array[int],
    peak: wp.array[int],
    naconmax: int,
    depth: wp.array[float],
    depth_limit: float,
    bits: wp.array[int],
    broken: wp.array[bool],
    taint: wp.array[wp.uint8],
):
    """Set the bits of TAINTS from overflows, penetration and broken worlds of a control step.

    ``bits`` (3,): masks of the engine's overflow bits for lost contacts, lost constraint rows and other warnings. Bits
    of TAINTS, lowest first: contacts, constraints, nan, engine, penetration.
    """
    world = wp.tid()
    found = wp.int32(0)
    # The engine does not tell whose pairs were dropped, so every world is tainted.
    if (overflow[world] & bits[0]) != 0 or peak[0] > naconmax:
        found = found | 1
    if (overflow[world] & bits[1]) != 0:
        found = found | 2
    if (overflow[world] & bits[2]) != 0:
        found = found | 8
    if depth[world] < -depth_limit:
        found = found | 16
    if broken[world]:
        found = found | 4
    taint[world] = taint[world] | wp.uint8(found)


@wp.kernel
def teleport(
    update: wp.array[bool],
    new_qpos: wp.array2d[float],
    tree_q: wp.array[wp.vec2i],
    tree_v: wp.array[wp.vec2i],
    stops: wp.array[int],
    awake: int,
    qpos: wp.array2d[float],
    qvel: wp.array2d[float],
    tree_asleep: wp.array2d[int],
):
    """Write qpos, and wake every tree that moves together with the trees of its sleep ring.

    Without waking them, objects whose support moved away would stay in the air. ``tree_q``, ``tree_v``: first index and
    number of each tree's entries in qpos and qvel. ``stops``: whether a tree's velocity becomes zero: 2 always, 1 if it
    moves, 0 never. ``awake``: value of ``tree_asleep`` of a tree that was just woken.
    """
    world = wp.tid()
    if not update[world]:
        return
    for tree in range(tree_q.shape[0]):
        moved = wp.bool(False)
        for i in range(tree_q[tree][0], tree_q[tree][0] + tree_q[tree][1]):
            # Exactly: rows of the present state are copied, and must leave their trees asleep.
            if qpos[world, i] != new_qpos[world, i]:
                moved = True
                qpos[world, i] = new_qpos[world, i]
        if stops[tree] == 2 or (stops[tree] == 1 and moved):
            for i in range(tree_v[tree][0], tree_v[tree][0] + tree_v[tree][1]):
                qvel[world, i] = 0.0
        if moved:
            # ``tree_asleep`` links the trees that fell asleep together in a cycle.
            sleeper = int(tree)
            # At most as many as there are trees: a broken ring must not hang the device.
            for _ in range(tree_q.shape[0]):
                following = tree_asleep[world, sleeper]
                # An awake tree is in no ring.
                if following < 0:
                    break
                tree_asleep[world, sleeper] = awake
                sleeper = following
            tree_asleep[world, tree] = awake


@wp.kernel
def restore_sleep(
    update: wp.array[bool],
    saved: wp.array2d[int],
    tree_asleep: wp.array2d[int],
):
    """Restore ``tree_asleep`` from ``saved`` in the worlds outside of mask ``update``."""
    world, tree = wp.tid()
    if not update[world]:
        tree_asleep[world, tree] = saved[world, tree]


@wp.kernel
def any_of(update: wp.array[bool], found: wp.array[int]):
    """Set ``found`` to 1 if any world is in mask ``update``; the caller has set it to 0."""
    if update[wp.tid()]:
        found[0] = 1


@wp.kernel
def unite(a: wp.array[bool], b: wp.array[bool], either: wp.array[bool]):
    """Write the union of two masks of worlds to ``either``."""
    world = wp.tid()
    either[world] = a[world] or b[world]


@wp.kernel
def keep_rows(fresh: wp.array[bool], rows: wp.array[int], kept: wp.array[int]):
    """Copy ``rows`` to ``kept`` for the worlds of mask ``fresh``."""
    world = wp.tid()
    if fresh[world]:
        kept[world] = rows[world]


@wp.kernel
def copy_rows(
    fresh: wp.array[bool],
    rows: wp.array[int],
    table: wp.array2d[float],
    out: wp.array2d[float],
):
    """Copy row ``rows[world]`` of a table to ``out[world]`` for the worlds of mask ``fresh``."""
    world, i = wp.tid()
    if fresh[world]:
        out[world, i] = table[rows[world], i]


@wp.kernel
def begin_worlds(
    fresh: wp.array[bool],
    new_qpos: wp.array2d[float],
    new_ctrl: wp.array2d[float],
    new_rings: wp.array2d[int],
    awake: int,
    qpos: wp.array2d[float],
    qvel: wp.array2d[float],
    ctrl: wp.array2d[float],
    warmstart: wp.array2d[float],
    time: wp.array[float],
    tree_asleep: wp.array2d[int],
):
    """Reset the worlds of mask ``fresh`` to ``new_qpos`` and ``new_ctrl``, with zero velocity, warm start and time.

    ``new_rings``: -1 for an awake tree, else the next tree of its sleep ring.
    """
    world = wp.tid()
    if not fresh[world]:
        return
    time[world] = 0.0
    for i in range(qpos.shape[1]):
        qpos[world, i] = new_qpos[world, i]
    for i in range(qvel.shape[1]):
        qvel[world, i] = 0.0
        warmstart[world, i] = 0.0
    for i in range(ctrl.shape[1]):
        ctrl[world, i] = new_ctrl[world, i]
    for tree in range(tree_asleep.shape[1]):
        ring = new_rings[world, tree]
        if ring < 0:
            ring = awake
        tree_asleep[world, tree] = ring


@wp.kernel
def clear_flags(
    fresh: wp.array[bool],
    overflow: wp.array[int],
    taint: wp.array[wp.uint8],
    broken: wp.array[bool],
):
    """Clear overflow, taint and broken flags of the worlds of mask ``fresh``."""
    world = wp.tid()
    if fresh[world]:
        overflow[world] = 0
        taint[world] = wp.uint8(0)
        broken[world] = False


@wp.kernel
def note_overflow(
    overflow: wp.array[int],
    peak: wp.array[int],
    naconmax: int,
    pairs_bit: int,
    seen: wp.array[int],
):
    """Add the engine's overflow bits of this control step to ``seen``, which is never cleared."""
    bits = overflow[wp.tid()]
    if peak[0] > naconmax:
        bits = bits | pairs_bit
    # Most worlds have none, and atomics on one address wait for each other.
    if bits != 0:
        wp.atomic_or(seen, 0, bits)
