"""Keys of an environment's entries, for all parts that read or change goals, rewards and ends."""

from __future__ import annotations

from dataclasses import dataclass

from tensordict import NestedKey

# Flags that BehaviorGoals writes: the goal was proposed; a proposed goal was achieved in the episode.
PROPOSED, PROPOSED_REACHED = "proposed", "proposed_reached"


@dataclass(frozen=True, kw_only=True)
class EnvKeys:
    """Keys of the entries of an environment with goals.

    Args:
        observation, achieved_goal, desired_goal, reward, terminated, done: keys of these entries.
        truncated: key of the flag of the time limit; None if there is none.

    Example:
        >>> EnvKeys(reward=("agent", "reward")).reward
        ('agent', 'reward')
    """

    observation: NestedKey = "observation"
    achieved_goal: NestedKey = "achieved_goal"
    desired_goal: NestedKey = "desired_goal"
    reward: NestedKey = "reward"
    terminated: NestedKey = "terminated"
    truncated: NestedKey | None = "truncated"
    done: NestedKey = "done"

    def check_ends(self, *, continues_after_termination: bool) -> None:
        """Raises a ValueError if ``truncated`` is None for an environment that stops at termination."""
        if self.truncated is None and not continues_after_termination:
            raise ValueError(
                "continues_after_termination=False needs a key for truncated, to say where the environment "
                "ended"
            )
