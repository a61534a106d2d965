"""A Gaussian process is held against its definition, written out slowly."""

import numpy as np
import pytest
import torch
from scipy.stats import multivariate_normal

from training.runs.gaussian_process import (
    CONSTANT_AND_SMOOTH,
    FIT_ROWS,
    JITTER,
    SMOOTH_AND_LINEAR,
    TWO_FIDELITIES,
    Kernel,
    Points,
    Posterior,
    Processes,
    climb_likelihood,
    fit_processes,
    fit_two_fidelities,
    likeliest,
    sample_rows,
)

ROWS, INPUTS = 14, 3
ROUNDING = 1e-9  # of sums of some dozens of numbers of size 1, in double precision
SEEDS = 4000  # draws, so that a mean of deviation 1 is known to 0.016
OF_DRAWS = 5 / SEEDS**0.5  # five standard errors, of numbers of deviation 1


def kernel_of(terms, rng):
    noises = 2 if terms is TWO_FIDELITIES else 1
    return Kernel(terms, rng.uniform(0.5, 3, INPUTS), rng.uniform(0.3, 1.5, len(terms)), rng.uniform(0.1, 0.4, noises), 1.7)


def points_of(rng, count, *, mixed=True):
    return Points(rng.normal(size=(count, INPUTS)), (np.arange(count) % 3 == 0).astype(float) * mixed)


def covariance_written_out(kernel, a, b, *, a_second, b_second):
    """Of two rows, term by term as the module's text has them."""
    x, y = a / kernel.lengths, b / kernel.lengths
    total = 0.0
    for term, s in zip(kernel.terms, kernel.sizes, strict=True):
        if term.second and not (a_second and b_second):
            continue
        if term.shape == "smooth":
            total += s**2 * np.exp(-np.sum((x - y) ** 2) / (2 * (kernel.reach if term.reaches else 1.0) ** 2))
        else:
            total += s**2 * (np.dot(x, y) if term.shape == "linear" else 1.0)
    return total


def matrix_written_out(kernel, a, b):
    return np.array(
        [
            [covariance_written_out(kernel, x, y, a_second=p, b_second=q) for y, q in zip(b.inputs, b.second, strict=True)]
            for x, p in zip(a.inputs, a.second, strict=True)
        ]
    )


def noisy_written_out(kernel, points):
    noise = kernel.noises[points.second.astype(int)] if len(kernel.noises) > 1 else kernel.noises
    return matrix_written_out(kernel, points, points) + (noise**2 + JITTER) * np.eye(len(points))


@pytest.fixture(params=[SMOOTH_AND_LINEAR, TWO_FIDELITIES, CONSTANT_AND_SMOOTH], ids=["smooth and linear", "two fidelities", "constant"])
def case(request):
    rng = np.random.default_rng(3)
    return kernel_of(request.param, rng), points_of(rng, ROWS), rng.normal(size=ROWS), points_of(rng, 5)


def test_the_posterior_is_the_conditional_of_a_normal_distribution(case):
    kernel, points, label, asked = case
    matrix, between = noisy_written_out(kernel, points), matrix_written_out(kernel, asked, points)
    posterior = Posterior(kernel, points, label)
    assert posterior.mean(asked) == pytest.approx(between @ np.linalg.solve(matrix, label), abs=ROUNDING)
    expected = matrix_written_out(kernel, asked, asked) - between @ np.linalg.solve(matrix, between.T)
    assert posterior.covariance(asked) == pytest.approx(expected, abs=ROUNDING)


def test_a_row_is_left_out_as_if_it_had_never_been_there(case):
    kernel, points, label, _ = case
    left_out = Posterior(kernel, points, label).left_out
    for k in range(ROWS):
        others = np.arange(ROWS) != k
        without = Posterior(kernel, points.rows(others), label[others])
        assert without.mean(points.rows(np.array([k])))[0] == pytest.approx(left_out[k], abs=ROUNDING)


def test_a_group_is_left_out_as_if_it_had_never_been_there(case):
    kernel, points, label, _ = case
    group = np.arange(ROWS) // 3
    left_out = Posterior(kernel, points, label, group).left_out
    for name in np.unique(group):
        rows, others = np.flatnonzero(group == name), np.flatnonzero(group != name)
        without = Posterior(kernel, points.rows(others), label[others])
        assert without.mean(points.rows(rows)) == pytest.approx(left_out[rows], abs=ROUNDING)


def test_the_likelihood_is_that_of_a_normal_distribution(case):
    kernel, points, label, _ = case
    expected = multivariate_normal(np.zeros(ROWS), noisy_written_out(kernel, points)).logpdf(label)
    assert float(kernel.log_likelihood(points, label)) == pytest.approx(expected, abs=ROUNDING)


def test_climbing_finds_likelier_parameters():
    rng = np.random.default_rng(5)
    points, start = points_of(rng, 30, mixed=False), Kernel(SMOOTH_AND_LINEAR, np.full(INPUTS, 5.0), np.array([1.0, 0.3]), np.array([0.05]))
    label = np.sin(points.inputs[:, 0]) + 0.5 * points.inputs[:, 1] + 0.1 * rng.normal(size=30)
    found = climb_likelihood(start, points, label)
    assert found.log_likelihood(points, label) > start.log_likelihood(points, label) + 10
    assert found.lengths[2] > found.lengths[0], "the third input tells nothing"


def test_the_likeliest_kernel_has_no_likelier_one_beside_it_within_its_bounds():
    rng = np.random.default_rng(6)
    points = points_of(rng, 40, mixed=False)
    label = np.sin(2 * points.inputs[:, 0]) + 0.3 * rng.normal(size=40)  # two inputs tell nothing: their lengths go to the bound

    def kernel(length, size, noise):
        return Kernel(CONSTANT_AND_SMOOTH, np.full(INPUTS, length), np.full(2, size), np.array([noise]))

    least, most = kernel(0.1, 0.01, 0.1), kernel(30.0, 10.0, 1.0)
    found = likeliest(kernel(2.0, 0.7, 0.5), points, label, least=least, most=most)
    logs, low, high = found.logs(), least.logs(), most.logs()
    asked = torch.tensor(logs, requires_grad=True)
    value = found.with_logs(asked).log_likelihood(points, label)
    gradient = torch.autograd.grad(value, asked)[0].numpy()
    assert (logs >= low - ROUNDING).all() and (logs <= high + ROUNDING).all()
    at_low, at_high = logs < low + 1e-6, logs > high - 1e-6
    assert at_high.any() and not (at_low | at_high).all(), "the case has both: numbers at a bound and between"
    assert (np.abs(gradient[~at_low & ~at_high]) < 0.01).all()  # of a log likelihood: a change of 1 is what counts
    assert (gradient[at_low] <= 0).all() and (gradient[at_high] >= 0).all()
    assert found.noises[0] == pytest.approx(0.3, rel=0.3) and value > kernel(2.0, 0.7, 0.5).log_likelihood(points, label)


def test_draws_have_the_posteriors_mean_and_covariance():
    rng = np.random.default_rng(7)
    kernel = Kernel(CONSTANT_AND_SMOOTH, np.ones(INPUTS), np.array([0.3, 0.9]), np.array([0.2]))
    points, asked = points_of(rng, 6, mixed=False), points_of(rng, 3, mixed=False)
    posterior = Posterior(kernel, points, rng.normal(size=6))
    drawn = np.stack([posterior.draw(asked, np.random.default_rng(k)) for k in range(SEEDS)])
    assert drawn.mean(axis=0) == pytest.approx(posterior.mean(asked), abs=OF_DRAWS)
    assert np.cov(drawn.T) == pytest.approx(posterior.covariance(asked), abs=OF_DRAWS)
    assert np.array_equal(drawn[5], posterior.draw(asked, np.random.default_rng(5)))


def test_processes_of_many_labels_are_those_of_each_and_come_back_from_their_arrays():
    rng = np.random.default_rng(8)
    inputs, asked = rng.normal(size=(40, INPUTS)), Points.of(rng.normal(size=(6, INPUTS)))
    labels = np.column_stack([inputs[:, 0] ** 2, inputs[:, 1]])
    both, left_out = fit_processes(inputs, labels, seed=0)
    for k in range(2):
        alone, left = fit_processes(inputs, labels[:, k : k + 1], seed=0)
        assert np.array_equal(both(asked)[:, k], alone(asked)[:, 0]) and np.array_equal(left_out[:, k], left[:, 0])
    again = Processes.of_arrays(SMOOTH_AND_LINEAR, {key: torch.from_numpy(value) for key, value in both.arrays().items()})
    assert np.array_equal(again(asked), both(asked))
    with pytest.raises(KeyError, match="weight"):
        Processes.of_arrays(SMOOTH_AND_LINEAR, {key: value for key, value in both.arrays().items() if key != "weight"})


def test_a_simulated_state_says_nothing_of_the_real_offset_and_a_real_frame_does():
    rng = np.random.default_rng(9)
    simulated, real = rng.normal(size=(60, INPUTS)), rng.normal(size=(20, INPUTS))
    told, _ = fit_two_fidelities(simulated, simulated[:, :1], real, real[:, :1] + 2.0, seed=0)
    asked = rng.normal(size=(30, INPUTS))
    assert told(Points.of(asked, second=True)) == pytest.approx(asked[:, :1] + 2.0, abs=0.3)
    assert told(Points.of(asked)) == pytest.approx(asked[:, :1], abs=0.3)


def test_rows_are_drawn_once_each_and_never_more_than_needed():
    assert sorted(sample_rows(50, 0)) == list(range(50))
    many = sample_rows(3 * FIT_ROWS, 1)
    assert len(set(many.tolist())) == FIT_ROWS and not np.array_equal(many, sample_rows(3 * FIT_ROWS, 2))
