"""Loops that project 3D Gaussians to ellipses on a picture, with their colours, and the gradients back."""

from __future__ import annotations

import math

import numpy as np
from numba import prange

from ctm_plugin.cpu.compiled import compiled, fused_part

ZERO, HALF, ONE, TWO = (np.float32(value) for value in (0, 0.5, 1, 2))
EPS2D = np.float32(0.3)
"""Variance in pixels squared that is added to each projected Gaussian."""
PLANE, INVERSE = 3, 1
"""Channels after the colours, see :mod:`ctm_plugin.splats.render`."""
MEAN, CONIC, OPACITY, DEPTH, EXTENT, REACH, WIDTH, OVER, GEOMETRY = 0, 2, 5, 6, 7, 9, 10, 12, 14
"""Offsets of a Gaussian's numbers in its row: mean 2, conic 3, opacity, depth, extent 2 (0: invisible), squared radius
of its ellipse in standard deviations, variance along x at a given y and along y at a given x, inverse variances along x
and y; and the row's length."""


@fused_part
def _harmonics(basis, g, x, y, z, degrees):
    """Real spherical harmonics of l < 1 to 4, as :func:`ctm_plugin.rays.spherical_harmonics.harmonics` has them."""
    basis[g, 0] = np.float32(0.28209479177387814)
    if degrees > 1:
        first = np.float32(0.4886025119029199)
        basis[g, 1], basis[g, 2], basis[g, 3] = first * y, first * z, first * x
    if degrees > 2:
        second, third = np.float32(1.0925484305920792), np.float32(0.5462742152960396)
        basis[g, 4], basis[g, 5] = second * x * y, second * y * z
        basis[g, 6] = np.float32(0.31539156525252005) * (np.float32(3) * z * z - ONE)
        basis[g, 7], basis[g, 8] = second * x * z, third * (x * x - y * y)
    if degrees > 3:
        fourth, fifth, five = np.float32(0.5900435899266435), np.float32(0.4570457994644658), np.float32(5) * z * z
        basis[g, 9], basis[g, 15] = (
            fourth * y * (np.float32(3) * x * x - y * y),
            fourth * x * (x * x - np.float32(3) * y * y),
        )
        basis[g, 10] = np.float32(2.890611442640554) * x * y * z
        basis[g, 11], basis[g, 13] = fifth * y * (five - ONE), fifth * x * (five - ONE)
        basis[g, 12] = np.float32(0.3731763325901154) * z * (five - np.float32(3))
        basis[g, 14] = np.float32(1.445305721320277) * z * (x * x - y * y)


@fused_part
def _rotation(quats, g):
    """Rotation matrix of Gaussian g's quaternion, row by row, and one over the quaternion's length."""
    w, x, y, z = quats[g, 0], quats[g, 1], quats[g, 2], quats[g, 3]
    over = ONE / math.sqrt(w * w + x * x + y * y + z * z)
    w, x, y, z = w * over, x * over, y * over, z * over
    return (
        ONE - TWO * (y * y + z * z), TWO * (x * y - w * z), TWO * (x * z + w * y),
        TWO * (x * y + w * z), ONE - TWO * (x * x + z * z), TWO * (y * z - w * x),
        TWO * (x * z - w * y), TWO * (y * z + w * x), ONE - TWO * (x * x + y * y), over,
    )  # fmt: skip


@fused_part
def _local(means, g, camera):
    """A Gaussian's mean in the camera's frame, its x / z and y / z there, and both cut to the lens' reach."""
    x, y, z = means[g, 0] - camera[9], means[g, 1] - camera[10], means[g, 2] - camera[11]
    a = camera[0] * x + camera[1] * y + camera[2] * z
    b = camera[3] * x + camera[4] * y + camera[5] * z
    c = camera[6] * x + camera[7] * y + camera[8] * z
    over = ONE / max(c, camera[23])
    u, v = a * over, b * over
    return c, over, u, v, min(max(u, -camera[21]), camera[21]), min(max(v, -camera[22]), camera[22])


@fused_part
def _slopes(u, v, camera):
    """The lens' derivative in pixels: dx/du, dx/dv, dy/du, dy/dv; and where it images the point."""
    fx, fy, k1, k2, p1, p2, k3 = camera[12], camera[13], camera[16], camera[17], camera[18], camera[19], camera[20]
    square = u * u + v * v
    radial = ONE + square * (k1 + square * (k2 + square * k3))
    slope = TWO * (k1 + square * (TWO * k2 + square * np.float32(3) * k3))
    xy = slope * u * v + TWO * p1 * u + TWO * p2 * v
    xx = radial + slope * u * u + TWO * p1 * v + np.float32(6) * p2 * u
    yy = radial + slope * v * v + TWO * p2 * u + np.float32(6) * p1 * v
    x = u * radial + TWO * p1 * u * v + p2 * (square + TWO * u * u)
    y = v * radial + TWO * p2 * u * v + p1 * (square + TWO * v * v)
    return fx * xx, fx * xy, fy * xy, fy * yy, fx * x + camera[14], fy * y + camera[15]


@compiled(
    "void(f4[:,::1], f4[:,::1], f4[:,::1], f4[:,::1], f4[:,::1], f4[:,::1], f4[:,::1], f4[::1], i8, f4[:,::1],"
    " f4[:,::1], f4[:,::1])", fused=True,
)  # fmt: skip
def project(means, scales, quats, opacities, sh0, shN, shift, camera, degrees, flat, basis, colors):
    """Write where Gaussians lie on the picture, the harmonics of their directions, and their colours.

    As :func:`ctm_plugin.splats.gaussians.project`, with the channels of :mod:`ctm_plugin.splats.render` after the
    colours where these have room for them.
    """
    k = sh0.shape[1]
    for g in prange(len(means)):
        flat[g, :] = ZERO
        flat[g, DEPTH] = np.float32(1e30)
        depth, over_z, u, v, cu, cv = _local(means, g, camera)
        opacity = ONE / (ONE + math.exp(-opacities[g, 0]))
        reach = TWO * math.log(opacity * np.float32(255))
        if not (depth > camera[23] and reach > ZERO):
            continue
        xu, xv, yu, yv, x, y = _slopes(cu, cv, camera)
        mx, my = x + xu * (u - cu) + xv * (v - cv) + shift[g, 0], y + yu * (u - cu) + yv * (v - cv) + shift[g, 1]
        j0, j1, j2 = xu * over_z, xv * over_z, -(xu * cu + xv * cv) * over_z
        j3, j4, j5 = yu * over_z, yv * over_z, -(yu * cu + yv * cv) * over_z
        r = _rotation(quats, g)
        xx, xy, yy, xz, yz = ZERO, ZERO, ZERO, ZERO, ZERO
        for axis in range(3):
            size = math.exp(scales[g, axis])
            r0, r1, r2 = r[axis] * size, r[3 + axis] * size, r[6 + axis] * size
            a = camera[0] * r0 + camera[1] * r1 + camera[2] * r2
            b = camera[3] * r0 + camera[4] * r1 + camera[5] * r2
            c = camera[6] * r0 + camera[7] * r1 + camera[8] * r2
            p, q = j0 * a + j1 * b + j2 * c, j3 * a + j4 * b + j5 * c
            xx += p * p
            xy += p * q
            yy += q * q
            xz += p * c
            yz += q * c
        xx += EPS2D
        yy += EPS2D
        ex, ey = math.sqrt(reach * xx), math.sqrt(reach * yy)
        if not (mx + ex > ZERO and mx - ex < TWO * camera[25] and my + ey > ZERO and my - ey < TWO * camera[26]):
            continue
        over = ONE / (xx * yy - xy * xy)
        a, b, c = yy * over, -xy * over, xx * over
        sx, sy = a * xz + b * yz, b * xz + c * yz
        flat[g, 0], flat[g, 1], flat[g, 2], flat[g, 3], flat[g, 4] = mx, my, a, b, c
        flat[g, OPACITY], flat[g, DEPTH], flat[g, REACH] = opacity, depth, reach
        flat[g, EXTENT], flat[g, EXTENT + 1], flat[g, WIDTH], flat[g, WIDTH + 1] = ex, ey, ONE / a, ONE / c
        flat[g, OVER], flat[g, OVER + 1] = ONE / xx, ONE / yy
        x, y, z = means[g, 0] - camera[9], means[g, 1] - camera[10], means[g, 2] - camera[11]
        over = ONE / math.sqrt(x * x + y * y + z * z)
        _harmonics(basis, g, x * over, y * over, z * over, degrees)
        for channel in range(k):
            color = HALF + basis[g, 0] * sh0[g, channel]
            for i in range(1, degrees * degrees):
                color += basis[g, i] * shN[g, (i - 1) * k + channel]
            colors[g, channel] = max(color, camera[24])
        if colors.shape[1] == k + INVERSE:
            colors[g, k] = camera[23] * over_z
        if colors.shape[1] == k + PLANE:
            colors[g, k] = depth - sx * (mx - camera[25]) - sy * (my - camera[26])
            colors[g, k + 1], colors[g, k + 2] = sx, sy


@compiled(
    "void(f4[:,::1], f4[:,::1], f4[:,::1], f4[:,::1], f4[:,::1], f4[:,::1], f4[::1], i8, f4[:,::1], f4[:,::1],"
    " f4[:,::1], i8[::1], i4[::1], f4[:,::1], f4[:,::1], f4[:,::1], f4[:,::1], f4[:,::1], f4[:,::1], f4[:,::1],"
    " f4[:,::1])", fused=True,
)  # fmt: skip
def project_back(
    means, scales, quats, opacities, sh0, shN, camera, degrees, flat, basis, colors, starts, slots, rows,
    d_means, d_scales, d_turns, d_opacities, d_base, d_rest, d_shift,
):  # fmt: skip
    """Sum up each Gaussian's gradients over its tiles, and propagate them back to its parameters."""
    k = sh0.shape[1]
    for g in prange(len(means)):
        d_means[g, :], d_scales[g, :], d_turns[g, :], d_opacities[g, 0] = ZERO, ZERO, ZERO, ZERO
        d_base[g, :], d_rest[g, :], d_shift[g, :] = ZERO, ZERO, ZERO
        gx, gy, ga, gb, gc, go, gz = ZERO, ZERO, ZERO, ZERO, ZERO, ZERO, ZERO
        for j in range(starts[g], starts[g + 1]):
            s = slots[j]
            gx += rows[s, 0]
            gy += rows[s, 1]
            ga += rows[s, 2]
            gb += rows[s, 3]
            gc += rows[s, 4]
            go += rows[s, 5]
            for channel in range(k):
                d_base[g, channel] += rows[s, 6 + channel]
            if colors.shape[1] == k + INVERSE:
                gz += rows[s, 6 + k]
        if starts[g + 1] == starts[g]:
            continue
        d_shift[g, 0], d_shift[g, 1] = gx, gy
        opacity = flat[g, OPACITY]
        d_opacities[g, 0] = go * opacity * (ONE - opacity)
        for channel in range(k):
            change = d_base[g, channel] * np.float32(colors[g, channel] > camera[24])
            d_base[g, channel] = change * basis[g, 0]
            for i in range(1, degrees * degrees):
                d_rest[g, (i - 1) * k + channel] = change * basis[g, i]
        a, b, c, half = flat[g, CONIC], flat[g, CONIC + 1], flat[g, CONIC + 2], HALF * gb
        _, over, u, v, cu, cv = _local(means, g, camera)
        xu, xv, yu, yv, _, _ = _slopes(cu, cv, camera)
        j0, j1, j2 = xu * over, xv * over, -(xu * cu + xv * cv) * over
        j3, j4, j5 = yu * over, yv * over, -(yu * cu + yv * cv) * over
        a0 = camera[0] * j0 + camera[3] * j1 + camera[6] * j2  # the rows of J W
        a1 = camera[1] * j0 + camera[4] * j1 + camera[7] * j2
        a2 = camera[2] * j0 + camera[5] * j1 + camera[8] * j2
        b0 = camera[0] * j3 + camera[3] * j4 + camera[6] * j5
        b1 = camera[1] * j3 + camera[4] * j4 + camera[7] * j5
        b2 = camera[2] * j3 + camera[5] * j4 + camera[8] * j5
        r = _rotation(quats, g)
        da0, da1, da2, db0, db1, db2 = ZERO, ZERO, ZERO, ZERO, ZERO, ZERO
        w, x, y, z = quats[g, 0] * r[9], quats[g, 1] * r[9], quats[g, 2] * r[9], quats[g, 3] * r[9]
        dw, dx, dy, dz = ZERO, ZERO, ZERO, ZERO
        for axis in range(3):
            size, r0, r1, r2 = math.exp(scales[g, axis]), r[axis], r[3 + axis], r[6 + axis]
            p, q = size * (a0 * r0 + a1 * r1 + a2 * r2), size * (b0 * r0 + b1 * r1 + b2 * r2)
            # The conic's gradient, to the covariance's: -K G K. From right to left: along needles K is next to nothing.
            kp, kq = a * p + b * q, b * p + c * q
            gp, gq = ga * kp + half * kq, half * kp + gc * kq
            dp, dq = -TWO * (a * gp + b * gq), -TWO * (b * gp + c * gq)
            d_scales[g, axis] = dp * p + dq * q
            dp, dq = dp * size, dq * size
            da0 += dp * r0
            da1 += dp * r1
            da2 += dp * r2
            db0 += dq * r0
            db1 += dq * r1
            db2 += dq * r2
            g0, g1, g2 = dp * a0 + dq * b0, dp * a1 + dq * b1, dp * a2 + dq * b2  # of the rotation's column
            if axis == 0:
                dw += z * g1 - y * g2
                dx += y * g1 + z * g2
                dy += -TWO * y * g0 + x * g1 - w * g2
                dz += -TWO * z * g0 + w * g1 + x * g2
            elif axis == 1:
                dw += -z * g0 + x * g2
                dx += y * g0 - TWO * x * g1 + w * g2
                dy += x * g0 + z * g2
                dz += -w * g0 - TWO * z * g1 + y * g2
            else:
                dw += y * g0 - x * g1
                dx += z * g0 - w * g1 - TWO * x * g2
                dy += w * g0 + z * g1 - TWO * y * g2
                dz += x * g0 + y * g1
        dw, dx, dy, dz = TWO * dw, TWO * dx, TWO * dy, TWO * dz
        along = w * dw + x * dx + y * dy + z * dz
        d_turns[g, 0], d_turns[g, 1] = (dw - w * along) * r[9], (dx - x * along) * r[9]
        d_turns[g, 2], d_turns[g, 3] = (dy - y * along) * r[9], (dz - z * along) * r[9]
        # J's gradient, and what it and the mean's say of the point in the camera's frame.
        e0 = camera[0] * da0 + camera[1] * da1 + camera[2] * da2
        e1 = camera[3] * da0 + camera[4] * da1 + camera[5] * da2
        e2 = camera[6] * da0 + camera[7] * da1 + camera[8] * da2
        e3 = camera[0] * db0 + camera[1] * db1 + camera[2] * db2
        e4 = camera[3] * db0 + camera[4] * db1 + camera[5] * db2
        e5 = camera[6] * db0 + camera[7] * db1 + camera[8] * db2
        du, dv = xu * gx + yu * gy, xv * gx + yv * gy
        du -= (xu * over * e2 + yu * over * e5) * np.float32(abs(u) <= camera[21])
        dv -= (xv * over * e2 + yv * over * e5) * np.float32(abs(v) <= camera[22])
        c0, c1 = du * over, dv * over
        gz *= camera[23] * over
        c2 = -over * (gz + u * du + v * dv + e0 * j0 + e1 * j1 + e2 * j2 + e3 * j3 + e4 * j4 + e5 * j5)
        for axis in range(3):
            d_means[g, axis] = camera[axis] * c0 + camera[3 + axis] * c1 + camera[6 + axis] * c2
