"""Roads turn positions into gaps and neighbours; they know no drivers."""

from idm_env.roads.base import Road
from idm_env.roads.lane import Lane
from idm_env.roads.lanes import Lanes
from idm_env.roads.layout import End, lane_drop, off_ramp, on_ramp
from idm_env.roads.network import Network, Plan
from idm_env.roads.network_demand import Demand
from idm_env.roads.ring import Ring

__all__ = ["Demand", "End", "Lane", "Lanes", "Network", "Plan", "Ring", "Road", "lane_drop", "off_ramp", "on_ramp"]
