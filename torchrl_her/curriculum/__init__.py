"""Curriculum-HER: stages, their transforms, and how a run moves from one to the next."""

from torchrl_her.curriculum.guide import GuidedExploration
from torchrl_her.curriculum.normalization import count_inputs, restart_inputs
from torchrl_her.curriculum.orders import EpisodeStages, TeacherStudent
from torchrl_her.curriculum.relay import Relay, RelayPolicy
from torchrl_her.curriculum.stages import Curriculum, CurriculumProgress, CurriculumStage, zero_unused_inputs
from torchrl_her.curriculum.switch import enter_stage, set_stage_goals
from torchrl_her.curriculum.transforms import StageOutcomes, StateToObs, ZeroPad
from torchrl_her.curriculum.view import StageView

__all__ = [
    "Curriculum",
    "CurriculumProgress",
    "CurriculumStage",
    "EpisodeStages",
    "GuidedExploration",
    "Relay",
    "RelayPolicy",
    "StageOutcomes",
    "StageView",
    "StateToObs",
    "TeacherStudent",
    "ZeroPad",
    "count_inputs",
    "enter_stage",
    "restart_inputs",
    "set_stage_goals",
    "zero_unused_inputs",
]
