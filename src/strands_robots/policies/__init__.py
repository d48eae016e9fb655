"""What decides a robot's next action: the policy protocol, the registry, and the providers we bring."""

from __future__ import annotations

from strands_robots.policies.base import Action, Policy, Ranges
from strands_robots.policies.registry import ALIASES, create_policy, policy_names, resolve_provider

__all__ = ["ALIASES", "Action", "Policy", "Ranges", "create_policy", "policy_names", "resolve_provider"]
