"""Where vehicles are when an episode of an open road begins: never without the room that an entry asks for."""

import torch
from torch import Tensor

from idm_env.types import Driver


def with_room(
    place: Tensor, candidate: Tensor, lane: Tensor, length: Tensor, speed: Tensor, driver: Driver, end: Tensor
) -> Tensor:
    """Return places (m) at which every candidate has ``s0 + v T`` to the one before it on its lane.

    Whoever comes too close is as much further back as if it had waited at the entry; likewise, whoever could not stop
    with b before the ``end`` of its lane (m). Places behind the beginning of a lane are those of vehicles that still
    wait. Shapes ``(…, slots)``, slots of a lane in the order of departure; ``candidate`` is bool.
    """
    least, time_gap, brake = (x.expand_as(place) for x in (driver.min_gap, driver.time_gap, driver.comfort_decel))
    place = torch.minimum(place, end - least - speed.square() / (2.0 * brake))
    room = least + speed * time_gap
    own = torch.arange(place.shape[-1], device=place.device)
    for k in lane[candidate].unique().tolist():
        mine = candidate & (lane == k)
        lengths, rooms = (torch.where(mine, x.expand_as(place), 0.0).cumsum(-1) for x in (length, room))
        needed = lengths - length + rooms  # behind whoever is first
        limit, before = torch.where(mine, place + needed, torch.inf).cummin(-1)
        place = torch.where(mine & (before != own), limit - needed, place)
    return place
