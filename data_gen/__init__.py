"""Synthetic rolling datasets: designed, simulated, written shard by shard, checked."""
