"""Random functions of actions, selections and bound inputs, as graphs of CasADi's operations that share values."""

import casadi as ca
import numpy as np

UNARY = [
    ca.sin,
    ca.cos,
    ca.tanh,
    ca.atan,
    ca.erf,
    ca.fabs,
    ca.sign,
    lambda x: -x,
    lambda x: x**2,
    lambda x: x**3 / 3,
    lambda x: ca.exp(-(x**2)),
    lambda x: ca.sqrt(1 + x**2),
    lambda x: ca.log(1 + x**2),
    lambda x: ca.log1p(x**2),
    lambda x: ca.expm1(-(x**2)),
    lambda x: 1 / (1 + x**2),
    lambda x: ca.asinh(x) + ca.floor(x),
    lambda x: ca.power(1 + x**2, 0.7),
]
BINARY = [
    lambda x, y: x + y,
    lambda x, y: x - y,
    lambda x, y: x * y,
    lambda x, y: x / (1 + y**2),
    lambda x, y: ca.atan2(x, 1 + y**2),
    lambda x, y: ca.hypot(x, 1 + y),
    lambda x, y: ca.fmax(x, y),
    lambda x, y: ca.fmin(x, 2 * y),
    lambda x, y: ca.if_else(x > y, x, y**2),
    lambda x, y: ca.power(1 + x**2, ca.sin(y)),
    lambda x, y: ca.copysign(x, y),
]


class Grower:
    """Adds random operations to a pool of matrices."""

    def __init__(self, rng, pool, depth):
        self.rng = rng
        self.pool = list(pool)
        self.depth = depth  # of functions that call functions

    def pick(self):
        """A value, more often one of the last."""
        recent = self.rng.random() < 0.6
        return self.pool[int(self.rng.integers(max(0, len(self.pool) - 6) if recent else 0, len(self.pool)))]

    def grow(self, steps):
        for _ in range(steps):
            made = getattr(self, str(self.rng.choice(MOVES)))()
            if made is not None and 0 < made.numel() <= 40:
                self.pool.append(made if self.rng.random() < 0.5 else ca.sin(made))
        return self

    def unary(self):
        return UNARY[self.rng.integers(len(UNARY))](ca.densify(self.pick()))

    def binary(self):
        x, y = self.pick(), self.pick()
        if x.shape != y.shape and 1 not in (x.numel(), y.numel()):
            y = self.shaped(y, x.shape)
        return BINARY[self.rng.integers(len(BINARY))](ca.densify(x), ca.densify(y))

    def product(self):
        x, y = self.pick(), self.pick()
        return x @ self.shaped(y, (x.shape[1], int(self.rng.integers(1, 4)))) / 3

    def transpose(self):
        return self.pick().T

    def part(self):
        x = self.pick()
        rows, columns = (self.rng.integers(0, size, self.rng.integers(1, size + 1)).tolist() for size in x.shape)
        if self.rng.random() < 0.5:
            return x[rows, columns]
        return x[min(rows) : max(rows) + 1, min(columns) :: 2]

    def changed(self):
        x = ca.MX(ca.densify(self.pick()))
        row = int(self.rng.integers(x.shape[0]))
        x[row, :] = self.shaped(self.pick(), (1, x.shape[1]))
        return x

    def stacked(self):
        x, y = self.pick(), self.pick()
        if self.rng.random() < 0.5:
            return ca.vertcat(ca.vec(x), ca.vec(y))
        return ca.horzcat(x, self.shaped(y, (x.shape[0], 2)))

    def reshaped(self):
        x = self.pick()
        return ca.reshape(x, x.shape[1], x.shape[0])

    def repeated(self):
        return ca.repmat(self.pick(), 1, int(self.rng.integers(2, 4)))

    def summed(self):
        x = self.pick()
        return [ca.sum1, ca.sum2, ca.sumsqr, ca.norm_fro, ca.cumsum][self.rng.integers(5)](ca.densify(x) + 0.1)

    def dotted(self):
        x = self.pick()
        return ca.dot(ca.densify(x), ca.densify(self.shaped(self.pick(), x.shape)))

    def sparse(self):
        x = self.pick()
        kept = ca.Sparsity.triplet(*x.shape, [0, x.shape[0] - 1], [0, x.shape[1] - 1])
        return ca.project(ca.densify(x), kept) + (0 if self.rng.random() < 0.5 else x)

    def constant(self):
        return ca.MX(ca.DM(self.rng.normal(size=self.pick().shape).round(1)))

    def called(self):
        """A function of some values, called several times, written as scalars or mapped."""
        if not self.depth:
            return None
        args = [self.pick() for _ in range(self.rng.integers(1, 4))]
        symbols = [ca.MX.sym("x", *arg.shape) for arg in args]
        inner = Grower(self.rng, symbols, self.depth - 1).grow(int(self.rng.integers(3, 30)))
        function = ca.Function("inner", symbols, [inner.pool[-1], ca.sumsqr(inner.pick())])
        if self.rng.random() < 0.4:
            function = function.expand()
        results = function.call([self.shaped(self.pick(), arg.shape) for arg in args], False, True)
        if self.rng.random() < 0.5:
            again = function.call([ca.sin(ca.densify(arg)) for arg in args], False, True)
            results = [x + y for x, y in zip(results, again, strict=True)]
        elif self.rng.random() < 0.5:
            results = function.map(2).call([ca.horzcat(arg, ca.cos(ca.densify(arg))) for arg in args], False, True)
        self.pool.append(results[1])
        return results[0]

    def shaped(self, x, shape):
        """The numbers of a matrix, again and again, in another shape."""
        numbers = [i % x.numel() for i in range(shape[0] * shape[1])]
        return ca.reshape(ca.vec(ca.densify(x))[numbers], *shape)


MOVES = [
    *("unary", "unary", "binary", "binary", "product", "transpose", "part", "changed", "stacked", "reshaped"),
    *("repeated", "summed", "dotted", "sparse", "constant", "called"),
]
SHAPES = [(3, 3), (4, 1)]


def random_value(seed, u, s, p, q):
    """A number that follows from all that is given, by up to 60 operations."""
    rng = np.random.default_rng(seed)
    cases = []
    for _ in range(3):
        x, y, z = ca.MX.sym("x", *u.shape), ca.MX.sym("y", *p.shape), ca.MX.sym("z", *q.shape)
        made = Grower(rng, [x, y, z], 1).grow(int(rng.integers(2, 20))).pool[-1]
        cases.append(ca.Function("case", [x, y, z], [ca.densify(ca.sum1(ca.vec(ca.tanh(ca.densify(made)))))]))
    chosen = ca.Function.conditional("chosen", cases[:-1], cases[-1])(ca.dot(s, ca.DM([0, 1, 2])), u, p, q)
    grown = Grower(rng, [u, s, p, q, u * q[0], ca.sin(p) @ ca.vertcat(u[:3]), chosen], 2).grow(int(rng.integers(5, 60)))
    total = chosen
    for value in grown.pool[-5:]:
        total = total + ca.sum1(ca.vec(ca.tanh(ca.densify(value))))
    return ca.sin(total) + 0.1 * total
