"""The codes of a shadow mask's pixels, apart from `masks`: who reads masks needs no kernels."""

#: Values of a shadow mask (mono8). Covered: lit, between an echo and the shadow behind it; either the
#: target's own echo, laid over what it hides, or seabed that is seen under it.
MASK_OUTSIDE, MASK_COVERED, MASK_UNKNOWN, MASK_SHADOW = 0, 64, 128, 255
