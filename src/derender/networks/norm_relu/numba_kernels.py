"""Inner loops of normalisation and rectifier for Numba; importing this module imports Numba.

Maps come as (N, rows, span) with span a multiple of the channels: several neighbouring pixels a row, so
that inner loops are long enough to vectorise well. Sums run in float64. Both passes work out the same scale
and shift of each channel from the stored statistics, so that they agree on which values the rectifier cut.
"""

from typing import no_type_check

import numpy as np

from derender.render.numba_threads import kernel


@kernel
@no_type_check
def forward(values, weight, bias, slope, epsilon, result, statistics, start, stop):
    """Write the result and each group's mean and inverse deviation."""
    rows, span = values.shape[1], values.shape[2]
    channels, groups = len(weight), statistics.shape[1]
    width = channels // groups
    count = rows * span // groups
    total, square = np.empty(span), np.empty(span)
    scale, shift = np.empty(span, values.dtype), np.empty(span, values.dtype)
    below = scale.dtype.type(slope)
    for n in range(start, stop):
        total[:] = 0
        square[:] = 0
        for p in range(rows):
            for c in range(span):
                value = np.float64(values[n, p, c])
                total[c] += value
                square[c] += value * value
        for c in range(channels, span):
            total[c % channels] += total[c]
            square[c % channels] += square[c]
        for g in range(groups):
            mean, second = 0.0, 0.0
            for c in range(g * width, (g + 1) * width):
                mean += total[c]
                second += square[c]
            mean /= count
            variance = max(second / count - mean * mean, 0.0)
            statistics[n, g, 0] = mean
            statistics[n, g, 1] = 1 / np.sqrt(variance + epsilon)
        for c in range(span):
            channel = c % channels
            g = channel // width
            scale[c] = weight[channel] * statistics[n, g, 1]
            shift[c] = bias[channel] - statistics[n, g, 0] * scale[c]
        for p in range(rows):
            for c in range(span):
                value = values[n, p, c] * scale[c] + shift[c]
                result[n, p, c] = value if value > 0 else value * below


@kernel
@no_type_check
def backward(grad, values, weight, bias, statistics, slope, grad_values, each, start, stop):
    """Write the derivative by the input, and by weight and bias for each image (overwrites both)."""
    rows, span = values.shape[1], values.shape[2]
    channels, groups = len(weight), statistics.shape[1]
    width = channels // groups
    count = rows * span // groups
    plain, weighted = np.empty(span), np.empty(span)
    scale, shift = np.empty(span, values.dtype), np.empty(span, values.dtype)
    by_value, constant = np.empty(span, values.dtype), np.empty(span, values.dtype)
    below = scale.dtype.type(slope)
    for n in range(start, stop):
        for c in range(span):
            channel = c % channels
            g = channel // width
            scale[c] = weight[channel] * statistics[n, g, 1]
            shift[c] = bias[channel] - statistics[n, g, 0] * scale[c]
        plain[:] = 0
        weighted[:] = 0
        for p in range(rows):
            for c in range(span):
                value, flow = values[n, p, c], grad[n, p, c]
                passed = flow if value * scale[c] + shift[c] > 0 else flow * below
                plain[c] += passed
                weighted[c] += np.float64(passed) * np.float64(value)
        for c in range(channels, span):
            plain[c % channels] += plain[c]
            weighted[c % channels] += weighted[c]
        for g in range(groups):
            mean, inverse = np.float64(statistics[n, g, 0]), np.float64(statistics[n, g, 1])
            first, second = 0.0, 0.0
            for c in range(g * width, (g + 1) * width):
                along = (weighted[c] - mean * plain[c]) * inverse
                each[0, n, c] = along
                each[1, n, c] = plain[c]
                first += weight[c] * plain[c]
                second += weight[c] * along
            first /= count
            second /= count
            for c in range(g * width, (g + 1) * width):
                by_value[c] = -inverse * inverse * second
                constant[c] = inverse * (mean * inverse * second - first)
        for c in range(channels, span):
            by_value[c] = by_value[c % channels]
            constant[c] = constant[c % channels]
        for p in range(rows):
            for c in range(span):
                value, flow = values[n, p, c], grad[n, p, c]
                passed = flow if value * scale[c] + shift[c] > 0 else flow * below
                grad_values[n, p, c] = passed * scale[c] + value * by_value[c] + constant[c]
