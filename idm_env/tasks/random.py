"""Random numbers by counter: a function of (seed, episode, step), not of a generator's past.

So environment i of a vector draws what a single environment with its seed draws, in any order, in blocks, and without a
generator per environment. SplitMix64 (Steele, Lea, Flood 2014, OOPSLA) hashes the counter; Box–Muller makes two normals
of the two halves of one hash. Everything is a handful of integer operations on whole tensors, on any device.
"""

from __future__ import annotations

import math
import zlib
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from idm_env.compiled.kernels import may_run, threads


def _signed(x: int) -> int:
    return x - (1 << 64) if x >= 1 << 63 else x


GOLDEN = _signed(0x9E3779B97F4A7C15)
_FIRST = _signed(0xBF58476D1CE4E5B9)
_SECOND = _signed(0x94D049BB133111EB)
_LOW, _TURN = 0xFFFFFFFF, 2.0 * math.pi * 2.0**-32
_FACTORS = np.uint64(0x9E3779B97F4A7C15), np.array([0xBF58476D1CE4E5B9, 0x94D049BB133111EB], np.uint64)
_AT_ONCE = 1 << 17
"""Hashes that are made at once; of fewer, torch shares every call among threads, which wait for one another."""


def mix(z: Tensor) -> Tensor:
    """Return the SplitMix64 finaliser of int64 counters, elementwise: every input bit changes half of the output."""
    return _mixed(z.clone())


def _mixed(z: Tensor) -> Tensor:
    """Mix in place: numbers of many vehicles and steps at once would ask the system for fresh memory each time."""
    # torch shifts int64 arithmetically: the mask makes each shift a logical one.
    high = (z >> 30).bitwise_and_((1 << 34) - 1)
    z.bitwise_xor_(high).mul_(_FIRST)
    torch.bitwise_right_shift(z, 27, out=high)
    z.bitwise_xor_(high.bitwise_and_((1 << 37) - 1)).mul_(_SECOND)
    torch.bitwise_right_shift(z, 31, out=high)
    return z.bitwise_xor_(high.bitwise_and_((1 << 33) - 1))


class Draw(NamedTuple):
    """The randomness of one episode of every environment: one key each, int64, shape ``(environments,)``."""

    key: Tensor

    @classmethod
    def of(cls, seed: Tensor, episode: Tensor) -> Draw:
        """Return the keys of seeds and episode numbers, both int64."""
        return cls(mix(mix(seed + GOLDEN) + episode * _SECOND))

    def stream(self, name: str) -> Draw:
        """Return the randomness of something that has a name, independent of the episode's other randomness."""
        return Draw(mix(self.key ^ (zlib.crc32(name.encode()) << 20)))

    def uniforms(self, stream: int, width: int, dtype: torch.dtype) -> Tensor:
        """Return uniforms in (0, 1), shape ``(environments, width)``; each ``stream`` is independent of the others."""
        key = mix(self.key ^ (0x5851F42D4C957F2D + stream))
        counter = torch.arange(1, width + 1, dtype=torch.int64, device=key.device) * GOLDEN
        bits = (mix(key.unsqueeze(-1) + counter) >> 11) & ((1 << 53) - 1)
        return ((bits.to(torch.float64) + 0.5) * 2.0**-53).to(dtype)

    def normals(self, step: Tensor, steps: int, width: int, dtype: torch.dtype) -> Tensor:
        """Return standard normals of ``steps`` steps from ``step`` on, shape ``(steps, environments, width)``.

        ``step`` (int64, one per environment, may be negative in a warm-up) is the counter: the same step always gets
        the same numbers, whatever the block in which they are drawn. With u₁, u₂ the halves of a hash, ``√(−2 ln u₁)
        cos 2πu₂`` and ``√(−2 ln u₁) sin 2πu₂``; at most 6.8 standard deviations.
        """
        pairs, rows = (width + 1) // 2, len(self.key)
        normals = torch.empty(steps, rows, 2 * pairs, dtype=dtype, device=self.key.device)
        is_cpu, mode = self.key.device.type == "cpu", torch.is_inference_mode_enabled()
        each = max(1, _AT_ONCE // (rows * pairs)) if is_cpu else max(1, steps)

        def fill(begin: int, end: int) -> None:
            with torch.inference_mode(mode):
                for first in range(begin, end, each):
                    part = normals[first : min(first + each, end)]
                    high, low = self._halves(1 + step * pairs + first * pairs, len(part), pairs, dtype)
                    radius, angle = high.add_(0.5).mul_(2.0**-32).log_().mul_(-2.0).sqrt_(), low.mul_(_TURN)
                    torch.mul(radius, angle.cos(), out=part[..., :pairs])
                    torch.mul(radius, angle.sin_(), out=part[..., pairs:])

        threads.split(fill, steps, 1, threads.count(steps * rows * width) if is_cpu else 1)
        return normals[..., :width]

    def _halves(self, counter: Tensor, steps: int, pairs: int, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
        """Return both halves of hashes ``(steps, environments, pairs)``, of counters at the first step."""
        if self.key.device.type == "cpu" and may_run():
            from idm_env.compiled.kernels.counter_loops import halves

            high, low = torch.empty(2, steps, len(self.key), pairs, dtype=dtype)
            keys, begins = (x.numpy().view(np.uint64) for x in (self.key, counter))
            halves(keys, begins, *_FACTORS, high.numpy(), low.numpy())
            return high, low
        counters = torch.arange(steps * pairs, device=self.key.device).view(-1, 1, pairs) + counter.view(1, -1, 1)
        z = _mixed(counters.mul_(GOLDEN).add_(self.key.view(1, -1, 1)))
        return (z >> 32).bitwise_and_(_LOW).to(dtype), z.bitwise_and_(_LOW).to(dtype)
