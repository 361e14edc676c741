"""Colour differences by CIEDE2000, as men see them and as men without one kind of cones do."""

import numpy as np

# Machado, Oliveira and Fernandes, IEEE Trans. Visualization 15(6), 2009: severity 1, linear RGB.
SIGHT = {
    "normal": np.eye(3),
    "protanopia": np.array(
        [
            [0.152286, 1.052583, -0.204868],
            [0.114503, 0.786281, 0.099216],
            [-0.003882, -0.048116, 1.051998],
        ]
    ),
    "deuteranopia": np.array(
        [
            [0.367322, 0.860646, -0.227968],
            [0.280085, 0.672501, 0.047413],
            [-0.011820, 0.042940, 0.968881],
        ]
    ),
}

_TO_XYZ = np.array(
    [
        [0.4124564, 0.3575761, 0.1804375],
        [0.2126729, 0.7151522, 0.0721750],
        [0.0193339, 0.1191920, 0.9503041],
    ]
)
_WHITE = np.array([0.95047, 1.0, 1.08883])  # D65


def linear(color):
    """Return the linear RGB (.., 3) of colours "#rrggbb", or of sRGB values (.., 3) in [0, 1]."""
    if isinstance(color, str):
        color = [part / 255.0 for part in bytes.fromhex(color[1:])]
    s = np.asarray(color, dtype=float)
    return np.where(s <= 0.04045, s / 12.92, ((s + 0.055) / 1.055) ** 2.4)


def lab(rgb):
    """Return the CIELAB coordinates (.., 3) of linear RGB (.., 3)."""
    x = np.clip(rgb, 0.0, 1.0) @ _TO_XYZ.T / _WHITE
    f = np.where(x > (6 / 29) ** 3, np.cbrt(x), x / (3 * (6 / 29) ** 2) + 4 / 29)
    fx, fy, fz = np.moveaxis(f, -1, 0)
    return np.stack((116 * fy - 16, 500 * (fx - fy), 200 * (fy - fz)), axis=-1)


def difference(one, other):
    """Return the CIEDE2000 difference of CIELAB coordinates (.., 3).

    Symbols as in Sharma, Wu and Dalal, Color Research and Application 30(1), 2005.
    """
    (L1, a1, b1), (L2, a2, b2) = (
        np.moveaxis(np.asarray(x, float), -1, 0) for x in (one, other)
    )
    mean_c7 = ((np.hypot(a1, b1) + np.hypot(a2, b2)) / 2) ** 7
    g = 0.5 * (1 - np.sqrt(mean_c7 / (mean_c7 + 25.0**7)))
    a1, a2 = (1 + g) * a1, (1 + g) * a2
    C1, C2 = np.hypot(a1, b1), np.hypot(a2, b2)
    h1, h2 = (np.degrees(np.arctan2(b, a)) % 360 for a, b in ((a1, b1), (a2, b2)))
    dh = (h2 - h1 + 180) % 360 - 180
    dh = np.where(C1 * C2 == 0, 0.0, dh)
    dL, dC = L2 - L1, C2 - C1
    dH = 2 * np.sqrt(C1 * C2) * np.sin(np.radians(dh / 2))
    L, C = (L1 + L2) / 2, (C1 + C2) / 2
    h = np.where(np.abs(h1 - h2) > 180, (h1 + h2 + 360) / 2, (h1 + h2) / 2) % 360
    h = np.where(C1 * C2 == 0, h1 + h2, h)
    cos = [
        np.cos(np.radians(k * h + s)) for k, s in ((1, -30), (2, 0), (3, 6), (4, -63))
    ]
    T = 1 - 0.17 * cos[0] + 0.24 * cos[1] + 0.32 * cos[2] - 0.20 * cos[3]
    turn = 60 * np.exp(-(((h - 275) / 25) ** 2))
    R = -2 * np.sqrt(C**7 / (C**7 + 25.0**7)) * np.sin(np.radians(turn))
    S_L = 1 + 0.015 * (L - 50) ** 2 / np.sqrt(20 + (L - 50) ** 2)
    l, c, hue = dL / S_L, dC / (1 + 0.045 * C), dH / (1 + 0.015 * C * T)
    return np.sqrt(l**2 + c**2 + hue**2 + R * c * hue)
