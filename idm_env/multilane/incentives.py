"""Lane changes: drivers' accelerations on the lanes beside, and their wishes.

Effects see a scene with ``here``, ``left`` and ``right`` and know no topology; the road chooses, resolves conflicts and
executes. Hypothetical pairs are answered by the simulator's own effects, perception and adaptation included, up to what
limits the vehicle: it is the driver who decides. He judges by what he sees now, whatever his delay.
"""

import operator
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from idm_env.roads.adjacent import Side, Sideways
from idm_env.roads.linked import Linked
from idm_env.roads.merging import LANE, MERGER_GAP, MERGER_SPEED, merger
from idm_env.step import CarFollowingStep
from idm_env.types import FAR, Beside, Inputs, Neighbour, Params, Scene, State, Wish, mapped


class _Now:
    """The past of a pair that has none: what is seen now."""

    def at(self, scene: Scene, seconds: Tensor) -> Scene:
        return scene

    def pushed(self, scene: Scene) -> Tensor:
        raise NotImplementedError


NOW = _Now()


def seen_merging(view: Linked, state: State, who: Tensor, due: Tensor) -> State:
    """Return the state in which drivers remember who signals (slots, own for nobody), where they have decided.

    ``who`` (integers) has the shape ``(…, vehicles)``, to which ``due`` (bool) broadcasts.
    """
    gap, speed = view.to_slot(state.position, state.length, who), view.at(state.speed, who)
    some = (gap > 0) & (gap < 0.5 * FAR)
    fresh = {MERGER_GAP: torch.where(some, gap, FAR), MERGER_SPEED: torch.where(some, speed, 0.0)}
    memory = {name: torch.where(due, x, state.memory[name]) for name, x in fresh.items()}
    return state._replace(memory={**state.memory, **memory})


def wished(stepping: CarFollowingStep, scene: Scene, params: Params) -> Wish:
    """Return the sum and the largest of all utilities, and the least of all margins."""
    driver = stepping.wanted(scene, params)[2]
    total: Wish | None = None
    for effect in stepping.lane_change_models:
        wish = effect.change(scene, driver, dict(params[effect.name]))
        wish = wish._replace(left_most=wish.left, right_most=wish.right)
        if total is not None:
            pairs = zip(total, wish, strict=True)
            wish = Wish(*(_JOINS[k // 2](a, b) for k, (a, b) in enumerate(pairs)))
        total = wish
    assert total is not None
    left, right = _larger(total.left_margin, total.left_despite), _larger(total.right_margin, total.right_despite)
    assert left is not None and right is not None
    if total.left_must is not None and total.right_must is not None:
        assert total.left_most is not None and total.right_most is not None
        total = total._replace(
            left=total.left + total.left_must * (total.left_most - total.left),
            right=total.right + total.right_must * (total.right_most - total.right),
        )
    if stepping.rooms:  # no lane is entered on which one could not go on
        assert scene.left is not None and scene.right is not None
        left, right = (
            torch.where(side.exists > 0, margin, -FAR) for side, margin in ((scene.left, left), (scene.right, right))
        )
    return total._replace(left_margin=left, right_margin=right)


def _larger(a: Tensor | None, b: Tensor | None) -> Tensor | None:
    """Return the larger of two margins, of which either may not be said."""
    return b if a is None else a if b is None else torch.maximum(a, b)


_JOINS: tuple[Callable[[Any, Any], Any], ...] = (operator.add, torch.minimum, torch.maximum, _larger, _larger)
"""How two wishes are one: utilities, margins, largest utilities, margins despite, musts; to the left and right each."""


def lane_scene(
    stepping: CarFollowingStep, view: Sideways, sides: tuple[Side, Side], state: State, inputs: Inputs, params: Params
) -> Scene:
    """Return the scene with the driver's own lane, and those on his left and right."""
    scene = stepping.scene(state, inputs)._replace(history=NOW)
    if scene.merger is not None:  # whom to let in is no reason to change lanes
        scene = scene._replace(merger=merger({}, scene.speed))
    second = view.second_leader(scene.leader, state.length, scene.speed)
    third = view.follow(state, scene.leader, view.beyond(), second.gap, second.present)[1]
    now = stepping.wanted(scene, params)[0]
    skipped = scene._replace(leader=second, second_leader=scene.second_leader and third)
    without = stepping.wanted(skipped, params)[0]
    follower = view.behind(scene.leader, scene.speed, scene.accel)
    here = Beside(
        exists=torch.ones_like(scene.speed),
        leader=scene.leader,
        follower=follower,
        wanted=now,
        with_me=view.back(now) * follower.present,
        without_me=view.back(without) * follower.present,
        ends=_room(stepping, scene, view.goes_on(), params),
    )
    left, right = (
        _one_side(stepping, view, side, state, _on_lane(scene, step), now, params)
        for side, step in zip(sides, (1.0, -1.0), strict=True)
    )
    return scene._replace(here=here, left=left, right=right)


def _on_lane(scene: Scene, step: float) -> Scene:
    """Return the scene as it would be on the lane ``step`` to the left."""
    return scene if scene.lane is None else scene._replace(lane=scene.lane + step)


def _room(stepping: CarFollowingStep, scene: Scene, ends: Tensor, params: Params) -> Tensor:
    """Return how far drivers can go on on the lane of a scene (m): to its end, or as far as effects let them."""
    for effect in stepping.rooms:
        room = effect.room(scene, dict(params[effect.name]))
        assert room is not None
        ends = torch.minimum(ends, room)
    return ends


def _one_side(
    stepping: CarFollowingStep, view: Sideways, side: Side, state: State, scene: Scene, now: Tensor, params: Params
) -> Beside:
    """Return a lane beside: the driver behind its leader, and its follower behind the driver, in each driver's slot."""
    led = side.led.to(scene.speed.dtype)
    leader, second = view.follow(state, scene.leader, side.leader, side.gap, led)
    # What is nearer: the leader there or the end of that lane; behind an end there is nobody.
    nearest = view.before_end(leader, side.ends)
    second = second._replace(present=second.present * (nearest.gap == leader.gap).to(led.dtype))

    def his(x: Tensor) -> Tensor:
        return view.at(x, side.follower)

    behind = Neighbour(side.back_gap, his(scene.speed), his(scene.accel), side.followed.to(scene.speed.dtype))
    own = scene._replace(leader=nearest, second_leader=scene.second_leader and second, behind=scene.behind and behind)
    accel = stepping.wanted(own, params)[0]
    exists, ends = side.exists.to(scene.speed.dtype), _room(stepping, own, side.ends, params)
    if stepping.rooms:
        exists = torch.where(ends > 0, exists, 0.0)
    me = Neighbour(side.back_gap, scene.speed, scene.accel, torch.ones_like(scene.speed))
    mine = nearest._replace(gap=torch.where(nearest.present > 0, side.back_gap + state.length + nearest.gap, FAR))
    follower = mapped(his, scene)._replace(leader=me, second_leader=scene.second_leader and mine)
    if scene.lane is not None:  # he is on it already
        follower = follower._replace(lane=his(state.memory[LANE]))
    with_me = stepping.wanted(follower, mapped(his, dict(params)))[0]
    return Beside(exists, nearest, behind, accel, with_me * behind.present, his(now) * behind.present, ends)
