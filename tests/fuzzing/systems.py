"""System files with exponential growth, deep nesting, or contradictions."""

import random

from fuzzing.mutation import soup


def monstrous_yaml(base: str, rng: random.Random) -> str:
    """YAML with multiplying anchors, deep nesting, tags, and values of wrong types."""
    n, few = rng.choice([10, 100, 3000]), rng.choice([5, 9, 30])
    big = rng.choice(["1e308", "9" * 300, ".inf", "-.inf", ".nan", "0", "-1", "1e400", "0o777", "1:30:00"])
    laughs = "a0: &a0 [x, x, x, x, x, x, x, x, x]\n" + "".join(
        f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]\n" for i in range(1, few)
    )
    merged = "b0: &b0 {k: 1}\n" + "".join(
        f"b{i}: &b{i} {{<<: [{', '.join([f'*b{i - 1}'] * 9)}], k{i}: 1}}\n" for i in range(1, few)
    )
    options = [
        laughs,
        merged,
        base + "\n" + laughs,
        base + "\n" + merged,
        "a: &a [*a]",
        "a: &a {b: *a}",
        "[" * n,
        "{a: " * n,
        "[" * n + "]" * n,
        "".join(" " * i + "a:\n" for i in range(min(n, 500))),
        "- " * n + "x",
        "? " * n + "x",
        f"a: '{'x' * n * 100}'",
        "".join(f"k{i}: {i}\n" for i in range(n)),
        "k: 1\n" * n,
        f"!!python/object/apply:os.system ['echo {n}']",
        "!!binary aGVsbG8=",
        "a: 2001-12-14t21:59:43.10-05:00\nb: !!set {x, y}\nc: !!omap [a: 1]",
        "---\n" * n,
        f"%YAML 9.9\n---\n{base}",
        "\t" + base,
    ]
    if rng.random() < 0.6:
        lines = base.splitlines()
        at = rng.randrange(len(lines))
        lines[at] = (
            lines[at].partition(":")[0]
            + f": {rng.choice([big, _expression(rng), '*a', '[]', '{}', '~', ''])}"
        )
        return "\n".join(lines)
    return rng.choice(options)


def _expression(rng: random.Random) -> str:
    n = rng.choice([10, 1000, 20_000])
    big = rng.choice(["1e308", "9" * 300, "1e-300", "0"])
    return rng.choice(
        [
            "(" * n + "v" + ")" * n,
            "v + " * n + "v",
            f"uniform({big}, -{big})",
            f"x^{big}",
            f"v / ({big} - {big})",
            "__import__('os').system('id')",
            "if v > 0 then " * n + "v",
            soup(rng).replace("\n", " "),
            f"{big} s",
        ]
    )
