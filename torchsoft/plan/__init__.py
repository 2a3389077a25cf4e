"""Planning for any rig: motions, gains, networks and shapes that reach targets within limits, by
exact gradients through contact and friction."""

from torchsoft.plan.knots import Bounds
from torchsoft.plan.planning import Plan, plan
from torchsoft.plan.problem import Limit, Target

__all__ = ["Bounds", "Limit", "Plan", "Target", "plan"]
