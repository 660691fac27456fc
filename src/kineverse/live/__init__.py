"""The whole system, live: processes of a world, estimators and behaviours around a model server (layer 7)."""

from typing import TYPE_CHECKING

from kineverse._lazy import lazy_face

if TYPE_CHECKING:
    from .behaviour_process import BehaviourProcess as BehaviourProcess
    from .behaviours import (
        Behaviour as Behaviour,
        Closer as Closer,
        CloseByName as CloseByName,
        OpenByName as OpenByName,
        Tour as Tour,
    )
    from .live_page import LivePage as LivePage
    from .live_robot import LiveBelief as LiveBelief, LiveRobot as LiveRobot
    from .tracker_process import TrackerProcess as TrackerProcess
    from .world_process import WorldProcess as WorldProcess

lazy_face(__name__)
