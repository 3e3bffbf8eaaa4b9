"""Forward kinematics of a Panda arm for tests, NumPy or torch: links in a plane, so that values are known."""


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
