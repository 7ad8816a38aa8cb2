// Phase of fringes from their cosine and sine. Specification: fringes.py.
//
// TILE     pixels of one work-item: 1 on a GPU, many on a CPU

#pragma OPENCL FP_CONTRACT OFF
#include "common.clh"

__kernel void fringes_phase(
    const int pixels, MAP cosine_part, MAP sine_part, MAP residual, MAP noise, const int noise_step,
    const float residual_noise, const float misfit, const float cosine_variance, const float covariance,
    const float sine_variance, OUT phase, OUT phase_sigma, OUT modulation)
{
    const int low = get_global_id(0) * TILE, end = min(pixels, low + TILE);
    for (int p = low; p < end; ++p) {
        const float c = cosine_part[p], s = sine_part[p], square = c * c + s * s, deviation = noise[noise_step * p];
        const float variance = (cosine_variance * s - 2 * covariance * c) * s + sine_variance * c * c;
        const float usual = deviation > residual_noise || residual_noise != residual_noise ? deviation : residual_noise;
        const int odd = residual[p] > misfit * usual, empty = square == 0;
        modulation[p] = sqrt(square);
        phase[p] = odd | !(square > 0) ? NAN : azimuth_of(c, s);
        phase_sigma[p] = odd | empty ? INFINITY : deviation * sqrt(variance) / square;
    }
}
