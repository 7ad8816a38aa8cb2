"""What integration and fusion reach: each target of accuracy, and what was measured at full size.

``python tests/support/integration_report.py`` prints the table; given names of its parts, these alone.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator

import bilateral_oracle
import fused_ball
import numpy as np
import slope_oracle
import steps
import surfaces
from slope_oracle import Problem

SHAPE, PIXEL = (240, 320), (0.03, 0.03)
Row = tuple[str, str, str, bool]


def integrate(asked, **options):
    """Integrate; say so where the tolerance was not met, and take what there is."""
    from mirrorskin import engine

    given = {"sigma": False, **asked.options, **options}
    try:
        return engine.integrate(*asked.arguments, **given)
    except engine.NotConverged as told:
        print(f"  MISSED: {told}")
        return engine.integrate(*asked.arguments, **given, budget=5.0)


def problem(surface, shape=SHAPE, pixel_size=PIXEL, noise=0.0, **options):
    seen = surfaces.sample(surface, shape, pixel_size)
    added = np.random.default_rng([1, 31]).normal(0, noise, (2, *shape))
    return Problem(seen.dz_dx + added[0], seen.dz_dy + added[1], pixel_size, **options), seen.height


def masks(shape=SHAPE):
    return {
        "rectangle": np.ones(shape, bool),
        "disc": surfaces.disc(shape),
        "hole": surfaces.disc(shape, hole=0.4),
        "blobs": surfaces.blobs(shape),
        "two contacts": surfaces.two_contacts(shape),
        "one-pixel bridge": surfaces.two_contacts(shape, bridge=True),
        "single pixels": surfaces.specks(shape),
        "20 % holes": surfaces.holes(shape),
        "comb": surfaces.comb(shape),
        "spiral": surfaces.spiral(shape),
    }


def off_truth(found, expected):
    """Return the largest error as a share of the range, each component about its own mean."""
    seen = found.component >= 0
    error = np.where(seen, found.height - expected, 0.0)
    label = found.component[seen]
    error[seen] -= (np.bincount(label, error[seen]) / np.bincount(label))[label]
    return np.abs(error[seen]).max() / np.ptp(expected[seen])


def off_direct(asked):
    """Return the largest difference from the direct solve as a share of the range, and what was done."""
    found, expected = integrate(asked), slope_oracle.solve(asked)
    same = np.array_equal(found.component, expected.component)
    same &= np.array_equal(found.offset_unknown.astype(bool), expected.offset_unknown)
    error = np.nanmax(np.abs(found.height - expected.height)) / np.ptp(
        expected.height[expected.component >= 0]
    )
    return error, found, same


def exact() -> Iterator[Row]:
    """Measure planes and quadratics on any mask, at any tilt."""
    kinds = {
        "plane": surfaces.plane(0.3, -0.7),
        "nearly upright plane": surfaces.plane(*surfaces.STEEP),
        "bowl": surfaces.quadratic(0.004, 0.001, 0.003, 0.1, -0.2),
        "saddle": surfaces.quadratic(0.005, 0.01, -0.003),
    }
    for kind, surface in kinds.items():
        worst = {}
        for name, mask in masks().items():
            asked, height = problem(surface, mask=mask)
            worst[name] = off_truth(integrate(asked), height)
        name = max(worst, key=worst.__getitem__)
        yield f"{kind}, any mask", "1e-4 of range", f"{worst[name]:.1e} ({name})", worst[name] <= 1e-4


def bumps() -> Iterator[Row]:
    """Measure the peaks of bumps of all sizes."""
    for name in ("rectangle", "disc"):
        mask = masks()[name]
        for sigma in (3, 4, 5, 7, 10, 14, 20, 28, 40):
            asked, height = problem(surfaces.bump(sigma, 0.6 * sigma), mask=mask)
            found = integrate(asked).height
            ratio = float(np.ptp(found[mask]) / np.ptp(height[mask]))
            yield (
                f"bump of sigma {sigma} px, {name}",
                "1.000 +- 0.002",
                f"{ratio:.5f}",
                abs(ratio - 1) <= 0.002,
            )


def direct() -> Iterator[Row]:
    """Compare with the direct solve: masks, weights, cuts, known heights."""
    generator = np.random.default_rng(2)
    bump, cut_off = surfaces.bump(25, 20, 10, -5), surfaces.bump(30, 30, 150, 90)
    smooth = np.exp(np.stack([np.sin(place / 31) for place in surfaces.places(SHAPE)]))
    weights = smooth * np.exp(generator.normal(0, 0.5, smooth.shape))
    for name, mask in masks().items():
        options = {
            "": {},
            ", noise 0.2": {"noise": 0.2},
            ", uneven weights": {"noise": 0.2, "weights": weights},
            ", 50 cuts": {"noise": 0.2, "edges": surfaces.random_cuts(SHAPE, 50)},
        }
        for share in (0.0005, 0.01, 1.0):
            heights = np.where(generator.random(SHAPE) < share, 0.6 + 0 * mask, np.nan)
            options[f", {share:.2%} known"] = {"noise": 0.1, "heights": heights, "height_weights": 100.0}
        for what, given in options.items():
            surface = cut_off if what == "" else bump
            error, found, same = off_direct(problem(surface, mask=mask, **given)[0])
            label = f"{name}{what}: as the direct solve"
            told = f"{error:.1e} ({found.method}, {found.iterations})"
            yield label, "1e-4 of range", told, bool(error <= 1e-4 and same)


def refinement() -> Iterator[Row]:
    """Refine one surface from 64 to 2048 px."""
    for region in ("rectangle", "disc"):
        errors = []
        sizes = (64, 128, 256, 512, 1024, 2048)
        for size in sizes:
            mask = surfaces.disc((size, size), 0.99) if region == "disc" else np.ones((size, size), bool)
            surface, pixel = surfaces.cosines(size / 4.7, size / 16), (3 / size, 3 / size)
            asked, height = problem(surface, (size, size), pixel, mask=mask)
            errors.append(off_truth(integrate(asked), height))
        for size, coarse, fine in zip(sizes[1:], errors, errors[1:], strict=False):
            order = np.log2(coarse / fine)
            yield (
                f"refinement to {size} px, {region}",
                "order 2, or below 1e-5",
                f"{order:.2f} ({fine:.1e} of range)",
                bool(order >= 1.9 or fine <= 1e-5),
            )


def noise() -> Iterator[Row]:
    """Compare the spread of noise with the best linear unbiased estimate, by their covariances."""
    for size in (24, 36, 44):
        shape = size, size + 3
        places = surfaces.places(shape)
        even = np.ones((2, *shape))
        smooth = np.exp(np.stack([np.sin(place / 9) for place in places]))
        rough = np.exp(np.random.default_rng(4).normal(0, 0.5, smooth.shape))
        regions = {
            "rectangle": np.ones(shape, bool),
            "disc": surfaces.disc(shape),
            "20 % holes": surfaces.holes(shape),
        }
        for region, mask in regions.items():
            for weighing, weights in {"even": even, "smooth": smooth, "rough": smooth * rough}.items():
                asked = Problem(np.zeros(shape), np.zeros(shape), (1.0, 1.0), mask, weights)
                best = slope_oracle.propagation(asked, best=True)
                sigma = np.sqrt(slope_oracle.variance(asked))
                energy = np.sqrt(slope_oracle.height_variance(asked).mean() / np.mean(best**2 @ sigma**2))
                mine = _sampled(asked, best, sigma)
                yield (
                    f"noise, {region} of {size} px, weights {weighing}",
                    "1.05 of the best",
                    f"{mine:.4f} (the energy's own {energy:.4f})",
                    bool(mine <= 1.05),
                )


def _sampled(asked, best, sigma, draws=6):
    """Return the ratio of RMS errors, from what the engine's differs by from the best one's, and is added."""
    beyond = []
    generator = np.random.default_rng(5)
    for _ in range(draws):
        drawn = sigma * generator.normal(size=sigma.shape)
        dz_dx, dz_dy = drawn.reshape(2, *asked.dz_dx.shape)
        found = integrate(Problem(dz_dx, dz_dy, asked.pixel_size, **asked.options))
        beyond.append(found.height[asked.mask] - best @ drawn)
    return np.sqrt(1 + np.mean(np.square(beyond)) / np.mean(best**2 @ sigma**2))


def sigmas() -> Iterator[Row]:
    """Compare the sigma that is told with the standard deviation by the covariance."""
    shape = (44, 47)
    regions = {
        "rectangle": np.ones(shape, bool),
        "disc": surfaces.disc(shape),
        "20 % holes": surfaces.holes(shape),
    }
    for region, mask in regions.items():
        for given in (True, False):
            asked = Problem(
                np.zeros(shape), np.zeros(shape), PIXEL, mask, np.full(shape, 400.0) if given else None
            )
            expected = slope_oracle.height_variance(asked) * (1 if given else 1 / 400)
            dz_dx, dz_dy = np.random.default_rng(6).normal(0, 0.05, (2, *shape))
            found = integrate(Problem(dz_dx, dz_dy, PIXEL, **asked.options), sigma=True)
            seen = slope_oracle.build(asked).pixel >= 0
            large = expected > 0.05 * expected.mean()
            share = (expected / found.sigma[seen].astype(float) ** 2)[large]
            low, high = np.percentile(share, [1, 99])
            yield (
                f"sigma, {region}, weights {'given' if given else 'not given'}",
                "(error/sigma)^2 1 +- 0.15",
                f"{share.mean():.3f} (98 % of pixels {low:.2f} to {high:.2f})",
                bool(abs(share.mean() - 1) <= 0.15),
            )


def robust() -> Iterator[Row]:
    """Look for steps that nobody marked."""
    larger = {
        "half a ball on a plane": lambda: steps.on_grid(surfaces.ball_on_plane(60, 60), (140, 150), 60),
        "stairs of three": lambda: steps.on_grid(surfaces.stairs(3, 20, 42, 50), (40, 230), 42),
        "coin: ear": lambda: steps.on_coin(-6.0, 4.5, (240, 240), 0.015),
        "coin: writing, 0.04 mm pixels": lambda: steps.on_coin(-4.5, -5.3, (100, 100), 0.04),
    }
    for name, make in {**steps.CASES, **larger}.items():
        case = make()
        for degrees in (0.0, 1.0):
            slopes = steps.tilted(case.seen, np.radians(degrees))
            part = steps.determined(case, slopes)
            terms = bilateral_oracle.terms(*slopes, case.pixel_size, case.mask)
            least = bilateral_oracle.alternate(terms, 2.0)
            found = integrate(Problem(*slopes, case.pixel_size, case.mask), robust=True)
            energy = bilateral_oracle.energy_of(terms, found.height, 2.0) / least.energy[-1]
            error, plain = (
                np.nanmax(np.abs(steps.errors(height, case, part))) for height in (found.height, least.height)
            )
            links = max(np.abs(part).max() for part in steps.smooth_links(case, found.height))
            share = np.mean(part[case.mask] >= 0)
            yield (
                f"{name}, noise {degrees:g} deg: heights",
                "0.02 of the step",
                f"{error:.4f} (float64 {plain:.4f}; {share:.0%} determined)",
                bool(error <= 0.02),
            )
            yield f"{name}, noise {degrees:g} deg: smooth links", "0.02", f"{links:.4f}", bool(links <= 0.02)
            yield (
                f"{name}, noise {degrees:g} deg: energy",
                "1.001 of float64's",
                f"{energy:.4f}",
                bool(energy <= 1.001),
            )


def fusion() -> Iterator[Row]:
    """Fuse the ball, of data of eq. 10 and of the twin's frames."""
    from mirrorskin import engine
    from mirrorskin.engine.fusion import fuse_sources

    shape, pixel = (401, 400), 0.021
    for name in ("uint8", "uint8, noisy", "uint16"):
        for step in (0.1, 0.01):
            turn = fused_ball.turned(name, shape, pixel)
            found = engine.fuse(fused_ball.pressed(step, shape, pixel), turn, pixel)
            yield from _verdict(f"eq. 10, {name}, steps {step} mm", found, 55, pixel, 0.003)
    shape, pixel = (401, 400), 0.018
    for pivot in (0.0, 1.25, 40.0):
        for step, count in ((0.1, 20), (0.01, 160)):
            sources = fused_ball.twins(shape, pixel, step, count, pivot=(0.0, 0.0, pivot))
            found = fuse_sources(*sources)
            name = f"twin, steps {step} mm, pivot {pivot:g} mm up"
            yield from _verdict(name, found, 38, pixel, 0.010)


def _verdict(name, found, zenith, pixel, limit) -> Iterator[Row]:
    told = fused_ball.judge(found.height, zenith, pixel)
    seen = f"{told.answered:.1%} answered"
    yield (
        f"{name}: RMS",
        f"{limit} mm",
        f"{told.rms:.4f} ({seen})",
        told.rms <= limit and told.answered > 0.99,
    )
    yield f"{name}: apex", f"{limit} mm", f"{told.apex:.4f}", told.apex <= limit
    yield f"{name}: radius", "5.00 +- 0.01 mm", f"{told.radius:.4f}", abs(told.radius - 5) <= 0.01


def hole() -> Iterator[Row]:
    """Fill the hole of a press alone."""
    import geometry
    from stacks import ball

    from mirrorskin import engine

    shape, pixel = (401, 401), 0.0225
    for step, count, limit in ((0.01, 160, 0.020), (0.1, 30, np.inf)):
        for noise in (0.0, 1.5):
            source = ball(shape, pixel, step * np.arange(1, count + 1), noise=noise, seed=7)
            found = engine.reconstruct(source)
            error = found.height - geometry.sphere(shape, pixel).height
            inside = fused_ball.within(11, shape, pixel)
            apex, most = abs(float(error[200, 200])), float(np.abs(error[inside]).max())
            target = f"{limit:.3f} mm" if np.isfinite(limit) else "reported"
            told = f"apex {apex:.4f}, worst {most:.4f}"
            yield f"hole of a press, steps {step} mm, noise {noise:g}", target, told, apex <= limit


PARTS: dict[str, Callable[[], Iterator[Row]]] = {
    part.__name__: part for part in (exact, bumps, direct, refinement, noise, sigmas, robust, fusion, hole)
}


def main():
    missed = 0
    for name in sys.argv[1:] or PARTS:
        print(f"\n{name}: {PARTS[name].__doc__}")
        for what, target, measured, reached in PARTS[name]():
            missed += not reached
            print(f"  {what:52} {target:26} {measured:44} {'' if reached else 'MISSED'}", flush=True)
    print(f"\n{missed} missed")


if __name__ == "__main__":
    main()
