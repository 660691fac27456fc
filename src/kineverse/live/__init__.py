"""The whole system, live: processes of a world, estimators and behaviours around a model server (layer 7)."""

from typing import TYPE_CHECKING

from kineverse._lazy import lazy_face

if TYPE_CHECKING:
    from .behaviour_process import BehaviourProcess as BehaviourProcess
    from .behaviours import Behaviour as Behaviour
    from .learner_process import LearnerProcess as LearnerProcess
    from .live_page import LivePage as LivePage
    from .live_robot import LiveBelief as LiveBelief, LiveRobot as LiveRobot
    from .model_estimator import ModelEstimator as ModelEstimator
    from .tracker_process import TrackerProcess as TrackerProcess
    from .unknown_behaviour import OpenUnknown as OpenUnknown, make_unknown_scene as make_unknown_scene
    from .world_process import WorldProcess as WorldProcess

lazy_face(__name__)
