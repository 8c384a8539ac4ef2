"""Every policy that `--policy` knows keeps the same contract."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import pytest
from policy_contract import PolicyContract

from cosim.errors import BadInput
from cosim.types import SMOKE, Decision, History, MetaAction, Policy, PolicyContext
from policy.agents import POLICIES, make


@pytest.fixture(scope="module", autouse=True)
def _one_thread() -> Iterator[None]:
    """Torch as `cosim run` uses it (figures.md, Reproducibility)."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


class Some:
    """Commands the first AV by id, and SUMO drives the others."""

    name, label, observation = "some", "", SMOKE
    av_parameters: Mapping[str, str] = {}

    def reset(self, context: PolicyContext) -> None: ...

    def decide(self, histories: Mapping[str, History]) -> dict[str, Decision]:
        return {av: Decision(MetaAction.DECELERATE) for av in sorted(histories)[:1]}


class TestCommandingSome(PolicyContract):
    @pytest.fixture
    def policy(self) -> Policy:
        return Some()


class TestPolicies(PolicyContract):
    @pytest.fixture(scope="class", params=POLICIES)
    def policy(self, request: pytest.FixtureRequest) -> Policy:
        return make(request.param)

    def test_it_goes_by_the_name_of_the_table(self, policy: Policy) -> None:
        assert type(policy) is type(make(policy.name))


def test_an_unknown_policy_is_answered_with_the_nearest_one() -> None:
    with pytest.raises(BadInput, match=r"--policy='altruist_rule'.*did you mean 'altruist-rule'"):
        make("altruist_rule")
