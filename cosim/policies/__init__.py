"""Every policy for `--policy`: shipped policies, weights of a training, a user's own code."""

from pathlib import Path
from typing import Protocol

from cosim.errors import BadInput
from cosim.policies.own import own
from cosim.road import RoadMap
from cosim.scenario.policy_name import WEIGHTS, read
from cosim.types import Compensator, Policy, Timing
from policy import agents


class Explainer(Protocol):
    """Attribution of each choice to the network's inputs (`policy.attribution.Explainer`)."""

    asked: str | None  # the observed AV
    uses: tuple[tuple[str, str, int, float], ...]  # input, replacement, action then, mean |dQ|


NAMES = tuple(agents.POLICIES)  # of shipped policies
TRAINABLE = agents.TRAINABLE  # policies for `cosim train NAME`


def check(text: str, field: str = "--policy", file: object = None) -> None:
    """Raises BadInput for an unknown policy, naming the nearest one or the fault of its file.

    `field`: the option or field with the policy's name, in `file`.
    """
    try:
        _check(text)
    except BadInput as error:
        if error.field != "--policy":
            raise
        raise BadInput(error.problem, file=error.file or file, field=field, value=error.value) from None


def _check(text: str) -> None:
    name = read(text)
    if name.ships:
        if name.label not in agents.POLICIES and Path(name.label).is_dir():
            problem = f"no policy of this name ships; the folder beside you is written ./{name.label}"
            raise BadInput(problem, field="--policy", value=text)
        agents.check_name(name.label)
    elif name.label in agents.POLICIES:
        problem = f"a policy that ships is called {name.label}: label yours otherwise"
        raise BadInput(problem, field="--policy", value=text)
    elif name.place.endswith(WEIGHTS):
        from cosim.policies import trained  # torch: only when needed

        trained.check(Path(name.place))
    else:
        name.code.load("--policy")


def explainer(policy: Policy) -> Explainer | None:
    """The attribution of this policy's choices; None without a value network."""
    from policy.agents.prediction_aware import PredictionAware
    from policy.attribution import Explainer as Asking

    return Asking(policy) if isinstance(policy, PredictionAware) else None


def compensator(name: str, road: RoadMap, timing: Timing) -> Compensator:
    """The predictor that compensates a sensing level's delay, by its name."""
    from cosim.policies.compensation import COMPENSATORS  # torch: only when needed

    return COMPENSATORS[name](road, timing)


def make(text: str) -> Policy:
    """A fresh policy. Raises BadInput as `check`, and for unusable weights or code."""
    name = read(text)
    if name.ships:
        return agents.make(name.label)
    if not name.place.endswith(WEIGHTS):
        return own(name)
    from cosim.policies.trained import trained

    return trained(name)
