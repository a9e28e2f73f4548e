"""Colour spaces in closed form: handcrafted ones (Table 2 of the paper), and ones that are fitted to the scene.

A file is a colour space: its name is that of the space, the first sentence of its docstring what ``ctm list`` says, its
class ``Space`` a :class:`~ctm_plugin.color.transform.ColorTransform`.

| name     | channel 0         | channel 1             | channel 2         |
|----------|-------------------|-----------------------|-------------------|
| rgb      | R                 | G                     | B                 |
| hsv      | hue in turns      | saturation            | value             |
| hls      | hue in turns      | lightness             | saturation        |
| hsv_cart | (1 + s cos h) / 2 | (1 + s sin h) / 2     | value             |
| hls_cart | (1 + s cos h) / 2 | lightness             | (1 + s sin h) / 2 |
| lab      | L* / 100          | (a* + 128) / 255      | (b* + 128) / 255  |
| luv      | L* / 100          | (u* + 134) / 354      | (v* + 140) / 262  |

Fitted once, to the scene's training colours (:mod:`ctm_plugin.color.curves`; colours brighter than the scene's lie
beyond 1); black decodes to 0:

| name     | each channel, in [0, 1]                                  |
|----------|----------------------------------------------------------|
| gain     | times one number: the scene's range in [0, 0.9]          |
| log      | the range bent by log(1 + a u), its median in the middle |

Every one takes and returns ``[..., 3]``, computes in float32 (float64 stays), and has finite gradients everywhere,
on grey, black and white too. Decoding takes any point of [0, 1]^3, as a field may render any, and clips to [0, 1].

Sources: hue spaces, Smith 1978 and https://en.wikipedia.org/wiki/HSL_and_HSV; Lab and Luv, CIE 15 with white D65 (2
degrees) and scikit-image's constants; their scales are OpenCV's for 8-bit images. kornia has the same formulas, but
converts through matrix products, which run in half precision under autocast and in TF32 on a GPU.
"""
