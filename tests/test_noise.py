"""Random numbers are a function of (seed, index) alone."""

import math

import hypothesis.strategies as st
import numpy as np
import pytest
import torch
from hypothesis import given
from scipy import stats

from lidar_synth.errors import ConfigError
from lidar_synth.noise import gaussian, keyed_rng, philox, uniform

WORD = st.integers(0, 2**32 - 1)

KNOWN = [  # kat_vectors of Random123: counter, key and output of philox4x32-10; lowest word first
    ((0, 0, 0, 0), (0, 0), (0x6627E8D5, 0xE169C58D, 0xBC57AC4C, 0x9B00DBD8)),
    (
        (0xFFFFFFFF, 0xFFFFFFFF, 0xFFFFFFFF, 0xFFFFFFFF),
        (0xFFFFFFFF, 0xFFFFFFFF),
        (0x408F276D, 0x41C83B0E, 0xA20BC7C6, 0x6D5451FD),
    ),
    (
        (0x243F6A88, 0x85A308D3, 0x13198A2E, 0x03707344),
        (0xA4093822, 0x299F31D0),
        (0xD16CFE09, 0x94FDCCEB, 0x5001E420, 0x24126EA1),
    ),
]


def philox_by_integers(counter: tuple[int, ...], seed: int) -> list[int]:
    """The published algorithm with Python integers, which do not overflow."""
    c = list(counter)
    k = [seed % 2**32, seed >> 32]
    for _ in range(10):
        high0, low0 = divmod(0xD2511F53 * c[0], 2**32)
        high1, low1 = divmod(0xCD9E8D57 * c[2], 2**32)
        c = [high1 ^ c[1] ^ k[0], low1, high0 ^ c[3] ^ k[1], low0]
        k = [(k[0] + 0x9E3779B9) % 2**32, (k[1] + 0xBB67AE85) % 2**32]
    return c


@pytest.mark.parametrize(("counter", "key", "output"), KNOWN)
def test_philox_gives_the_published_test_vectors(
    counter: tuple[int, ...], key: tuple[int, int], output: tuple[int, ...]
) -> None:
    seed = key[0] | key[1] << 32
    assert philox(torch.tensor(counter), seed).tolist() == list(output)
    assert philox_by_integers(counter, seed) == list(output)


@given(counter=st.tuples(WORD, WORD, WORD, WORD), seed=st.integers(0, 2**64 - 1))
def test_philox_on_tensors_equals_philox_on_integers(
    counter: tuple[int, ...], seed: int
) -> None:
    assert philox(torch.tensor(counter), seed).tolist() == philox_by_integers(
        counter, seed
    )


def test_numbers_follow_the_documented_counter_layout() -> None:
    seed = 2**63 + 5
    index = 2**40 + 7
    words = [
        philox_by_integers((block, index % 2**32, index >> 32, 0), seed)
        for block in range(3)
    ]
    expected = []
    for w in words:
        for a, b in (w[:2], w[2:]):
            radius = math.sqrt(-2 * math.log((a + 0.5) / 2**32))
            angle = 2 * math.pi * b / 2**32
            expected += [radius * math.cos(angle), radius * math.sin(angle)]
    assert gaussian(seed, [index], (2, 5)).flatten().tolist() == pytest.approx(
        expected[:10], rel=1e-6
    )
    words = philox_by_integers((0, index % 2**32, index >> 32, 1), seed)
    assert uniform(seed, [index]).item() == ((words[0] >> 9) + 0.5) / 2**23


def test_gaussian_numbers_never_change() -> None:
    """If these numbers change, every scan of every seed changes."""
    expected = [
        [0.991137683391571, -0.9246625900268555],
        [1.1363673210144043, -0.6758829951286316],
    ]
    assert torch.allclose(gaussian(0, [0, 1], (2,)), torch.tensor(expected), atol=1e-7)


@given(
    seed=st.integers(0, 2**64 - 1),
    indices=st.lists(st.integers(0, 2**63 - 1), min_size=1, max_size=5),
    size=st.integers(1, 40),
)
def test_a_sample_depends_on_neither_its_batch_nor_its_shape(
    seed: int, indices: list[int], size: int
) -> None:
    for draw in (gaussian, uniform):
        together = draw(seed, indices, (size,))
        for row, index in zip(together, indices, strict=True):
            assert torch.equal(row, draw(seed, [index], (size,))[0])
            assert torch.equal(row, draw(seed, [index], (2, size))[0, 0])


def test_all_bits_of_seed_and_index_matter() -> None:
    draws = [
        gaussian(s, [i], (8,))
        for s in (0, 1, 2**32, 2**63)
        for i in (0, 1, 2**31, 2**32, 2**62)
    ]
    assert len({tuple(d.flatten().tolist()) for d in draws}) == 20


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_cpu_and_cuda_agree() -> None:
    for draw in (gaussian, uniform):
        cpu = draw(9, [3, 2**40], (2, 64, 1024))
        cuda = draw(9, [3, 2**40], (2, 64, 1024), "cuda")
        assert cuda.device.type == "cuda"
        assert (cpu - cuda.cpu()).abs().max() <= 1e-6


@pytest.mark.slow
def test_gaussian_numbers_are_normal_and_independent() -> None:
    x = gaussian(11, range(100), (2, 16, 64)).double().numpy().reshape(100, -1)
    assert stats.kstest(x.ravel(), "norm").pvalue > 0.001
    assert abs(x.mean()) < 4 / math.sqrt(x.size)
    assert abs(stats.kurtosis(x.ravel())) < 4 * math.sqrt(24 / x.size)
    neighbours = {
        "elements": (x[:, :-1], x[:, 1:]),
        "pairs of one transform": (x[:, 0::2], x[:, 1::2]),
        "indices": (x[:-1], x[1:]),
        "seeds": (
            x,
            gaussian(12, range(100), (2, 16, 64)).double().numpy().reshape(100, -1),
        ),
        "streams": (
            x,
            uniform(11, range(100), (2, 16, 64)).double().numpy().reshape(100, -1)
            - 0.5,
        ),
    }
    for name, (a, b) in neighbours.items():
        for power in (1, 2):
            r = np.corrcoef((a**power).ravel(), (b**power).ravel())[0, 1]
            assert abs(r) < 4 / math.sqrt(a.size), (name, power)


def test_uniform_numbers_are_uniform_in_the_open_interval() -> None:
    u = uniform(5, range(20000))
    assert stats.kstest(u.numpy(), "uniform").pvalue > 0.001
    ends = torch.tensor([0, 2**32 - 1]) >> 9
    assert ((ends.float() + 0.5) * 2.0**-23).tolist() == [2.0**-24, 1 - 2.0**-24]


def test_dtypes_are_rounded_from_float64() -> None:
    exact = gaussian(1, range(3), (7,), dtype=torch.float64)
    for dtype in (torch.float32, torch.bfloat16, torch.float16):
        assert torch.equal(gaussian(1, range(3), (7,), dtype=dtype), exact.to(dtype))
    assert gaussian(1, [], (3, 2)).shape == (0, 3, 2)


@pytest.mark.parametrize(
    ("seed", "indices", "shape", "message"),
    [
        (-1, [0], (1,), r"seed -1; expected 0 <= seed < 2\^64"),
        (2**64, [0], (1,), "seed 18446744073709551616"),
        (0, [3, -2], (1,), r"index -2; expected 0 <= index < 2\^63"),
        (0, [2**63], (1,), "index 9223372036854775808"),
        (0, [1, 0.5], (1,), r"index 0.5; .* an integer"),
        (0.5, [1], (1,), r"seed 0.5; .* an integer"),
        (0, [0], (2, 0), r"noise of shape \(2, 0\); expected positive sizes"),
    ],
)
def test_arguments_out_of_range_are_refused(
    seed: int, indices: list[int], shape: tuple[int, ...], message: str
) -> None:
    with pytest.raises(ConfigError, match=message):
        gaussian(seed, indices, shape)


@given(
    st.lists(st.integers(0, 2**64 - 1), max_size=4),
    st.lists(st.integers(0, 2**64 - 1), max_size=4),
)
def test_keyed_generators_depend_only_on_their_key(a: list[int], b: list[int]) -> None:
    def first(key: list[int]) -> int:
        return int(keyed_rng(*key).integers(2**63))

    assert first(a) == first(a)
    assert (first(a) == first(b)) == (a == b)
    assert len({first([*a, *zeros]) for zeros in ([], [0], [0, 0])}) == 3


def test_keys_with_large_integers_do_not_collide() -> None:
    assert keyed_rng(0, 1 + (5 << 32)).random() != keyed_rng(1 << 32, 5).random()


@pytest.mark.parametrize("key", [(-1,), (0, 2**64)])
def test_a_key_out_of_range_is_refused(key: tuple[int, ...]) -> None:
    with pytest.raises(ConfigError, match="2\\^64"):
        keyed_rng(*key)
