"""Train Stable-Baselines3's DQN briefly on the environment of `merge`; prints figures before and after.

    python examples/train_sb3_dqn.py --steps 5000 --out runs/sb3-dqn.zip    # driven by examples/sb3_policy.py

The AV in conflict with the mission vehicle learns, without a safety mask; SUMO's IDM drives the others.
A few thousand steps raise the return; a safe and altruistic driver takes far more (docs/results/).
"""

from __future__ import annotations

import argparse
import statistics
from typing import TYPE_CHECKING

import gymnasium

if TYPE_CHECKING:
    from stable_baselines3 import DQN

VALIDATION_SEED = 100_000  # neither a training seed (below) nor a test seed (from 200,000)


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=5000, help="decisions to train for")
    parser.add_argument("--episodes", type=int, default=10, help="evaluation episodes before and after")
    parser.add_argument("--demand", default="contested")
    parser.add_argument("--svo", type=float, default=45.0, help="social value orientation, degrees")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", help="save the model here")
    args = parser.parse_args(arguments)

    # not at the top, because the simulation's process imports this file too
    import torch
    from stable_baselines3 import DQN

    torch.set_num_threads(1)
    with_mlp = {"demand": args.demand, "svo": args.svo, "flatten": "kinematics"}
    env = gymnasium.make("cosim:cosim/Merge-v0", **with_mlp)
    test_env = gymnasium.make("cosim:cosim/Merge-v0", **with_mlp)
    model = DQN(
        "MlpPolicy",
        env,
        learning_rate=5e-4,  # this, the batch and the target update: P, Table I
        batch_size=64,
        target_update_interval=300,
        gamma=0.97,
        n_steps=8,  # n-step returns, as in cosim's learner
        buffer_size=50_000,
        learning_starts=min(500, args.steps // 4),
        train_freq=1,
        exploration_fraction=0.5,
        exploration_final_eps=0.05,
        seed=args.seed,
        device="cpu",
    )
    report("before", evaluate(model, test_env, args.episodes))
    model.learn(args.steps)
    report(f"after {args.steps} steps", evaluate(model, test_env, args.episodes))
    if args.out:
        model.save(args.out)
    env.close()
    test_env.close()


def evaluate(model: DQN, env: gymnasium.Env, episodes: int) -> dict[str, float | None]:  # type: ignore[type-arg]
    """Means over `episodes` validation episodes, acting greedily."""
    returns, crashed, merged, distances = [], [], [], []
    for k in range(episodes):
        seen, _ = env.reset(seed=VALIDATION_SEED + k)
        total, over = 0.0, False
        while not over:
            action, _ = model.predict(seen, deterministic=True)
            seen, reward, terminated, truncated, info = env.step(action)
            total, over = total + float(reward), terminated or truncated
        figures = info["episode_metrics"]
        returns.append(total)
        crashed.append(float(figures["crashed"]))
        merged.append(float(figures["mission_success"] or False))
        distances.append(figures["dt_mean_m"])
    return {
        "return": statistics.mean(returns),
        "crashed": statistics.mean(crashed),
        "merged": statistics.mean(merged),
        "distance_m": statistics.mean(distances),
    }


def report(when: str, figures: dict[str, float | None]) -> None:
    print(f"{when:<18}", "  ".join(f"{name} {value:.2f}" for name, value in figures.items()), flush=True)


if __name__ == "__main__":
    main()
