"""Vectors of environments in threads."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.vector.utils import iterate

from torchsoft.envs.rig_env import RigEnv
from torchsoft.physics.arguments import whole
from torchsoft.threads import cores, executor, parallel_map


class RigVectorEnv(SyncVectorEnv):
    """Environments whose steps and resets run in `threads` threads, by default one for each core.
    Results do not depend on the number of threads.

    Only one thread at a time computes in Python, which is two thirds of a short step; where that
    counts, gymnasium's `AsyncVectorEnv` takes processes.
    """

    def __init__(
        self, make: Sequence[Callable[[], RigEnv]], *, threads: int | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
    ) -> None:  # fmt: skip
        if not make:
            raise ValueError("`make` must hold one function an environment, but is empty")
        threads = cores() if threads is None else whole("threads", threads, 1)
        super().__init__(make, autoreset_mode=autoreset_mode)
        self._pool = executor(min(threads, len(make)))

    def step(self, actions: Any) -> Any:
        """Step all environments, as gymnasium's `SyncVectorEnv` does."""
        every, todo = self.envs, list(iterate(self.action_space, actions))
        again = self.autoreset_mode is AutoresetMode.NEXT_STEP

        def work(i: int) -> _Done:
            if again and self._autoreset_envs[i]:
                return _Done(None, every[i].reset())
            stepped = every[i].step(todo[i])
            over = (stepped[2] or stepped[3]) and self.autoreset_mode is AutoresetMode.SAME_STEP
            return _Done(stepped, every[i].reset() if over else None)

        done = dict(parallel_map(work, len(every), turns=True, pool=self._pool))
        try:
            self.envs = [done[i] for i in range(len(every))]  # pyright: ignore[reportAttributeAccessIssue]
            return super().step(actions)
        finally:
            self.envs = every

    def close_extras(self, **how: Any) -> None:
        """End the threads and the environments."""
        self._pool.shutdown()
        super().close_extras(**how)


class _Done(NamedTuple):
    """Results of an environment, in the interface of an environment."""

    stepped: Any
    begun: Any

    def step(self, _: Any) -> Any:
        return self.stepped

    def reset(self, **_: Any) -> Any:
        return self.begun
