"""Curriculum-HER: layers, their transforms, and how a run moves from one to the next."""

from torchrl_her.curriculum.guide import GuidedExploration
from torchrl_her.curriculum.layers import Curriculum, CurriculumLayer, CurriculumProgress, zero_unused_inputs
from torchrl_her.curriculum.normalization import count_inputs, restart_inputs
from torchrl_her.curriculum.orders import EpisodeLayers, TeacherStudent
from torchrl_her.curriculum.switch import enter_layer, set_layer_goals
from torchrl_her.curriculum.transforms import LayerOutcomes, StateToObs, ZeroPad
from torchrl_her.curriculum.view import LayerView

__all__ = [
    "Curriculum",
    "CurriculumLayer",
    "CurriculumProgress",
    "EpisodeLayers",
    "GuidedExploration",
    "LayerOutcomes",
    "LayerView",
    "StateToObs",
    "TeacherStudent",
    "ZeroPad",
    "count_inputs",
    "enter_layer",
    "restart_inputs",
    "set_layer_goals",
    "zero_unused_inputs",
]
