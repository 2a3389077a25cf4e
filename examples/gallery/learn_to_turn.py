"""
A policy trained by the gradient of its episodes
================================================

Can two soft jaws learn in fifty episodes to turn a disc to any angle? The environment is one of
gymnasium's, for any library of reinforcement learning. Its step in torch has a gradient, so that
the distances to the goal are differentiated with respect to the weights of the policy.
"""

import gymnasium
import matplotlib.pyplot as plt
import torch
from torch import nn

torch.manual_seed(0)
env = gymnasium.make("torchsoft.envs:torchsoft/Reorient-v0", render_mode="rgb_array")
env = env.unwrapped  # its step is also one in torch
dynamics, (seen,), (actions,) = env.dynamics, env.observation_space.shape, env.action_space.shape
policy = nn.Sequential(nn.Linear(seen, 30), nn.Tanh(), nn.Linear(30, actions), nn.Tanh()).double()


def evaluate(seeds: range) -> list[float]:
    """Errors of the angle [rad] at the end of gymnasium's episodes."""
    missed = []
    for seed in seeds:
        (observation, _), over = env.reset(seed=seed), False
        while not over:
            action = policy(torch.as_tensor(observation).double()).detach().numpy()
            observation, _, *ends, _ = env.step(action)
            over = any(ends)
        missed.append(abs(float(dynamics.distance(env.moment)[0])) * dynamics.goal.scale["theta"])
    return missed


untrained, history = evaluate(range(100, 106)), []
optimiser = torch.optim.Adam(policy.parameters(), lr=0.02)
schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, 25)
for i in range(25):
    distances = []
    for angle in ((0.5, -0.5), (0.2, -0.2))[i % 2]:
        moment = dynamics.begin(torch.tensor([angle, 0.0], dtype=torch.float64))
        observation = dynamics.observe(moment)
        for _ in range(12):
            moment, observation, _, _ = dynamics.step(moment, policy(observation))
            distances.append((1 + dynamics.distance(moment).square().sum()).sqrt())
    loss = torch.stack(distances).mean()
    optimiser.zero_grad()
    loss.backward()
    nn.utils.clip_grad_norm_(policy.parameters(), 1.0)
    optimiser.step()
    schedule.step()
    history.append(loss.item())
trained = evaluate(range(100, 106))
print(f"missed at most: {max(untrained):.2f} rad untrained, {max(trained):.2f} rad trained")

_, axes = plt.subplots(1, 2, figsize=(9, 3.5), layout="constrained")
axes[0].plot(history)
axes[0].set(xlabel="step of the optimiser", ylabel="mean distance to the goal")
axes[1].imshow(env.render())
plt.show()
