"""Where the hand of a planar arm is: a function outside, for tests. It asks for nothing but array operators."""


def hand(q):
    """Joints (..., 2) in rad -> position (..., 2) in m; links of 1 m, small angles."""
    stretched = q * q
    return 2.0 * q - stretched * q / 6.0


def span(a, b):
    """Two numbers to one."""
    return a * a + b


def wrong(q):
    """One component too few."""
    return q[..., :1]


def broken(q):
    """Never returns."""
    raise ZeroDivisionError(q.shape)
