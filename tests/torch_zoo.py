"""Small modules of every kind that robots' networks are made of, and modules that have no symbolic expression."""

import math
import warnings
from collections import OrderedDict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from copy import deepcopy
from dataclasses import dataclass
from functools import partial, reduce
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor, nn, tensor
from torch.func import functional_call
from torch.nn import functional as F
from torch.nn.attention import SDPBackend, sdpa_kernel
from torch.nn.functional import scaled_dot_product_attention as attend
from torch.nn.utils.parametrizations import orthogonal, spectral_norm, weight_norm
from torch.nn.utils.parametrize import register_parametrization as register
from torch.overrides import TorchFunctionMode
from torch.utils import _pytree as pytree

Shapes = tuple[tuple[int, ...], ...]


@dataclass(frozen=True)
class Entry:
    """A module with an expression."""

    name: str
    make: Callable[[], nn.Module]
    shapes: Shapes  # of the tensors that forward takes, batch included


@dataclass(frozen=True)
class Refusal(Entry):
    """A module without one."""

    path: str  # of the submodule that is the reason, as in named_modules
    says: str  # in the message


# What a test needs


class TwiceDifferentiable(TorchFunctionMode):
    """Formulas in place of kernels that torch.func differentiates only once, or with constants in single precision."""

    FORMULAS = {  # noqa: RUF012
        F.hardsigmoid: lambda x, **_: F.relu6(x + 3) / 6,
        F.celu: lambda x, alpha=1.0, *_, **__: torch.where(x > 0, x, alpha * torch.expm1(x.clamp(max=0) / alpha)),
        F.rrelu: lambda x, lower, upper, *_, **__: F.leaky_relu(x, (lower + upper) / 2),
        torch.cdist: lambda x, y, **_: (x.unsqueeze(-2) - y.unsqueeze(-3)).norm(dim=-1),
    }

    def __torch_function__(self, function, types, args=(), kwargs=None):
        return self.FORMULAS.get(function, function)(*args, **kwargs or {})


@contextmanager
def reference(module: nn.Module) -> Iterator[nn.Module]:
    """A copy of the module that torch evaluates and differentiates twice, in double precision."""
    dtype, fast = torch.get_default_dtype(), torch.backends.mha.get_fastpath_enabled()
    torch.set_default_dtype(torch.float64)
    torch.backends.mha.set_fastpath_enabled(False)
    try:
        with sdpa_kernel(SDPBackend.MATH), TwiceDifferentiable(), warnings.catch_warnings():
            warnings.filterwarnings("ignore", ".*(torch.jit|batching rule)")  # from within torch.func
            yield deepcopy(module).double().eval()
    finally:
        torch.set_default_dtype(dtype)
        torch.backends.mha.set_fastpath_enabled(fast)


def inputs(entry: Entry, seed: int, scale: float = 1.5) -> tuple[Tensor, ...]:
    """Random tensors for the module, in double precision."""
    generator = torch.Generator().manual_seed(seed)
    return tuple(scale * torch.randn(shape, generator=generator, dtype=torch.float64) for shape in entry.shapes)


def flat(outputs: Any) -> Tensor:
    """All outputs of a module in one vector, however it nests them."""
    return torch.cat([leaf.reshape(-1) for leaf in pytree.tree_leaves(outputs)])


# What the modules are put together from


def seeded(build: Callable[[], nn.Module], shapes: Shapes = ()) -> Callable[[], nn.Module]:
    """The same module at every call; if the shapes are given, without lazy layers and trivial weights."""

    def make() -> nn.Module:
        dtype = torch.get_default_dtype()
        with torch.random.fork_rng(devices=[]), warnings.catch_warnings():
            warnings.filterwarnings("ignore", "Lazy modules|.*torch.jit|.*nested_tensor|LSTM with projections")
            torch.manual_seed(0)
            torch.set_default_dtype(torch.float32)  # or other random numbers would be drawn
            try:
                module = build()
                return settled(module, shapes) if shapes else module
            finally:
                torch.set_default_dtype(dtype)

    return make


@torch.no_grad()
def settled(module: nn.Module, shapes: Shapes) -> nn.Module:
    module.eval()(*map(torch.randn, shapes))  # lazy layers see their sizes
    for weight in module.parameters():
        weight += 0.1 * torch.randn_like(weight)  # or gains of 1 and offsets of 0 would hide mistakes
    return module


class Of(nn.Module):
    """A function of the module and its inputs; parts are sizes of a perceptron, tensors, or what makes a part."""

    def __init__(self, function: Callable, **parts: Any):
        super().__init__()
        self.function = function
        for name, part in parts.items():
            made = mlp(*part) if isinstance(part, tuple) else part() if callable(part) else part
            if isinstance(made, Tensor) and not isinstance(made, nn.Parameter):
                self.register_buffer(name, made.clone())
            else:
                setattr(self, name, made)

    def forward(self, *xs: Tensor) -> Any:
        return self.function(self, *xs)


class Chain(nn.Sequential):
    """Layers, the first of any number of inputs."""

    def forward(self, *xs: Tensor) -> Any:
        for layer in self:
            xs = (layer(*xs),)
        return xs[0]


def of(function: Callable, *shapes: tuple[int, ...], **parts: Any) -> tuple:
    return partial(Of, function, **parts), *shapes


def mlp(*sizes: int) -> nn.Sequential:
    return nn.Sequential(*[layer for n, m in pairwise(sizes) for layer in (nn.Linear(n, m), nn.Tanh())][:-1])


def headed(build: Callable[[], nn.Module], *shapes: tuple[int, ...]) -> tuple:
    """A layer, two outputs, and a curvature also where the layer has none."""
    return lambda: Chain(build(), nn.Flatten(), nn.LazyLinear(2), nn.Tanh()), *shapes


def between(layer: Callable[[], nn.Module]) -> tuple:
    """A layer of four features, (1, 4)."""
    return lambda: nn.Sequential(nn.Linear(3, 4), layer(), nn.Flatten(), nn.LazyLinear(2)), (1, 3)


def matrices(function: Callable[[Tensor], Tensor]) -> tuple:
    """A function of two 3x2 matrices, after something curved and before two outputs."""
    result = partial(Of, lambda _, x: function(x.tanh() + 0.1 * x * x.flip(0)).reshape(1, -1))
    return lambda: nn.Sequential(result(), nn.LazyLinear(2)), (2, 3, 2)


def trained(*layers: nn.Module, shape: tuple[int, ...]) -> nn.Module:
    """The layers after several batches, from which they have their statistics."""
    module = nn.Sequential(*layers)
    for _ in range(20):
        module(2.0 * torch.randn(8, *shape) + 0.7)
    return module


def param(*shape: int) -> Callable[[], nn.Parameter]:
    return lambda: nn.Parameter(torch.randn(shape))


def noise(*shape: int) -> Callable[[], Tensor]:
    return lambda: torch.randn(shape)


def attention(**options: Any) -> Callable[[], nn.Module]:
    return lambda: nn.MultiheadAttention(4, 2, batch_first=True, **options)


def transformer(layer: type[nn.Module], **options: Any) -> Callable[[], nn.Module]:
    return lambda: layer(4, 2, dim_feedforward=5, batch_first=True, **options)


ENCODER = nn.TransformerEncoderLayer
CAUSAL = torch.ones(3, 3, dtype=torch.bool).triu(1)
MINUS = torch.zeros(3, 3).masked_fill(CAUSAL, -math.inf)

# Activations: layers of four features

ACTIVATIONS: dict[str, Callable[[], nn.Module]] = {
    "Identity": nn.Identity,
    "ReLU": nn.ReLU,
    "ReLU in place": lambda: nn.ReLU(inplace=True),
    "ReLU6": nn.ReLU6,
    "LeakyReLU": lambda: nn.LeakyReLU(0.1),
    "PReLU": lambda: nn.PReLU(4),
    "RReLU": nn.RReLU,
    "ELU": lambda: nn.ELU(1.3),
    "CELU": lambda: nn.CELU(0.7),
    "SELU": nn.SELU,
    "GELU": nn.GELU,
    "GELU tanh": lambda: nn.GELU("tanh"),
    "SiLU": nn.SiLU,
    "Mish": nn.Mish,
    "Softplus": nn.Softplus,
    "Softplus with threshold": lambda: nn.Softplus(beta=2.0, threshold=1.5),
    "Softsign": nn.Softsign,
    "Sigmoid": nn.Sigmoid,
    "LogSigmoid": nn.LogSigmoid,
    "Tanh": nn.Tanh,
    "Hardtanh": lambda: nn.Hardtanh(-0.5, 0.8),
    "Hardsigmoid": nn.Hardsigmoid,
    "Hardswish": nn.Hardswish,
    "Hardshrink": lambda: nn.Hardshrink(0.3),
    "Softshrink": lambda: nn.Softshrink(0.3),
    "Tanhshrink": nn.Tanhshrink,
    "Threshold": lambda: nn.Threshold(0.1, -0.4),
    "GLU": nn.GLU,
    "Softmax": lambda: nn.Softmax(dim=1),
    "Softmin": lambda: nn.Softmin(dim=-1),
    "LogSoftmax": lambda: nn.LogSoftmax(dim=1),
    "Softmax2d": lambda: nn.Sequential(nn.Unflatten(1, (2, 2, 1)), nn.Softmax2d()),
    "SwiGLU": partial(Of, lambda m, x: F.silu(m.gate(x)) * m.value(x), gate=(4, 3), value=(4, 3)),
    "Snake": partial(Of, lambda m, x: x + torch.sin(m.a.exp() * x) ** 2 / m.a.exp(), a=param(4)),
    "Swish": partial(Of, lambda m, x: x * torch.sigmoid(m.beta * x), beta=param()),
}

# Functions of four features

FEATURES: dict[str, Callable[[nn.Module, Tensor], Tensor]] = {
    "CReLU": lambda _, x: torch.cat([F.relu(x), F.relu(-x)], 1),
    "squared ReLU": lambda _, x: F.relu(x).square(),
    "SIREN": lambda _, x: torch.sin(3.0 * x),
    "normalize": lambda _, x: F.normalize(x, dim=-1),
    "where and comparisons": lambda _, x: torch.where((x > 0.2) & ~(x.exp() <= 0.9) | (x < -1), x.sin(), 0.5 * x * x),
    "masks as numbers": lambda _, x: (x >= 0).to(x.dtype) * x.square() + (x != 0).float() * x.cos() + (x > 0.5) * x,
    "masked mean": lambda _, x: (x * (x > -0.3)).sum(-1, True) / (x > -0.3).sum(-1, True).clamp(min=1),
    "any and all": lambda _, x: torch.where((x > 0.8).any(-1, True), x.exp(), x) * torch.where((x > -1).all(), x, 2),
    "minimum and maximum": lambda _, x: torch.minimum(x, x.sin()) + torch.maximum(x.flip(1), x * x) - x.fmax(x.cos()),
    "atan2 and hypot": lambda _, x: torch.atan2(x, x.roll(1, 1)) + torch.hypot(x, x.roll(2, 1)),
    "powers": lambda _, x: x**2 - x**3 + x.pow(0) + x**1 - 0.1 * x**4.0 + torch.pow(x, tensor([2, 3, 1, 0])),
    "negative powers": lambda _, x: (1.5 + x.square()) ** -2 + F.softplus(x) ** -0.3 + F.softplus(x) ** -1,
    "fractional powers": lambda _, x: F.softplus(x) ** 0.5 + F.softplus(x) ** 1.7 + 1.3**x + x.exp() ** x.sigmoid(),
    "roots": lambda _, x: F.softplus(x).sqrt() + F.softplus(x).rsqrt() + (2.0 + x.cos()).reciprocal() + 1.0 / x.exp(),
    "exponentials": lambda _, x: x.exp().mul(2.0).add_(x.exp2()).sub_(x.expm1()) + x.sigmoid().logit(),
    "logarithms": lambda _, x: F.softplus(x).log() + x.square().log1p() + (x.exp() + 1).log2() + F.softplus(x).log10(),
    "trigonometry": lambda _, x: x.sin() * x.cos() + x.sigmoid().tan() + x.atan(),
    "hyperbolic functions": lambda _, x: x.sinh() - x.cosh() + x.tanh() + x.asinh() + (1.1 + x.square()).acosh(),
    "inverse functions": lambda _, x: (0.9 * x.tanh()).asin() - (0.9 * x.sin()).acos() + (0.9 * x.sin()).atanh(),
    "error functions": lambda _, x: torch.erf(x) * torch.erfc(0.3 * x) + torch.special.ndtr(x) + torch.special.expit(x),
    "entropy": lambda _, x: torch.special.entr(x.sigmoid()) + torch.xlogy(x, x.exp() + 0.1) + torch.sinc(x),
    "signs": lambda _, x: x.sign() * x.abs() + x.neg() * x.sgn() + torch.copysign(x.square(), x.flip(1)) + x.positive(),
    "rounding": lambda _, x: x.floor() + x.ceil() * x + x.round() - x.trunc() + x.frac(),
    "wrapped angles": lambda _, x: torch.remainder(x + math.pi, 2 * math.pi) - math.pi + (2.0 * x) % 0.9,
    "differences and quotients": lambda _, x: (2.0 - x) / (1.0 + x.square()) + torch.rsub(x, 1.5, alpha=2) + x.div(3),
    "addcmul and addcdiv": lambda _, x: x.addcmul(x, x.flip(1), value=0.4) - x.addcdiv(x.sin(), x.exp(), value=2.0),
    "clamp": lambda _, x: x.clamp(-1.2, 0.5) * x.clamp(min=0.1) + x.clamp(max=x.new_tensor([0.1, 0.2, 0.3, 0.4])) * x,
    "constants made in forward": lambda _, x: x @ tensor([[0.1], [0.2], [0.3], [-0.7]]) + torch.linspace(0, 1, 4) * x,
    "integers made in forward": lambda _, x: torch.arange(4) * x.sin() + torch.eye(4) @ x[0] + x.new_ones(4) * x,
    "Chebyshev polynomials": lambda _, x: torch.cos(torch.arange(3) * torch.acos(0.95 * x.tanh())[..., None]),
    "sinkhorn steps": lambda _, x: sinkhorn(x.view(2, 2)).view(1, 4),
}

# Functions of two 3x2 matrices in one tensor

MATRICES: dict[str, Callable[[Tensor], Tensor]] = {
    "slices": lambda x: x[:, 1:] - x[..., :-1, :] + x[1, ::2, -1],
    "slices backwards": lambda x: x.flip((0, 2)) * x.roll(1, 1) - x.roll((1, -1), (0, 2)),
    "select and narrow": lambda x: x.select(0, 1) + x.narrow(1, 0, 3)[0],
    "permute, transpose, movedim": lambda x: x.permute(2, 0, 1) + x.movedim(2, 0) - x.mT.transpose(0, 1),
    "chunk, split, unbind": lambda x: torch.cat([*x.split((1, 2), 1), x.chunk(3, 1)[1] * x.unbind(0)[1][:1]], 1),
    "stack": lambda x: torch.stack([x[0], x[1].sin(), x[0] * x[1]], -1),
    "hstack, vstack, dstack": lambda x: torch.vstack([torch.hstack([*x]), torch.dstack([*x]).flatten(1)]),
    "expand, repeat, tile": lambda x: x[:1].expand(2, -1, -1) * x.repeat(1, 2, 1)[:, 2:5] + x[:, :, :1].tile(1, 1, 2),
    "repeat_interleave": lambda x: x.repeat_interleave(2, 1)[:, 1:4] * x,
    "broadcasting": lambda x: x[:, :, None, :] * x[:, None, :, :] - x[:, :1, None],
    "squeeze and unsqueeze": lambda x: x[:, :1].squeeze(1).unsqueeze(-1) * x[:, 1].unsqueeze(1),
    "flatten and view": lambda x: x.flatten(0, 1).view(2, 2, 3).sin() + x.reshape(-1, 2, 3),
    "windows": lambda x: x.unfold(1, 2, 1).mean(-1),
    "diagonals": lambda x: torch.diag_embed(x[0]) + torch.diagonal(x[:, :2], dim1=0, dim2=1).sum() + x[:, 1].trace(),
    "tril and triu": lambda x: x[:, :2].tril() @ x[:, 1:].triu(1) + x.mT.tril(-1)[..., :2],
    "meshgrid": lambda x: torch.sub(*torch.meshgrid(x[0, :, 0], x[1, :, 1], indexing="ij")),
    "assigned slices": lambda x: assigned(x.flatten()),
    "einsum, trace and diagonal": lambda x: torch.einsum("bii->b", x[:, :2]) + torch.einsum("bii->bi", x[:, 1:]),
    "einsum, ellipsis": lambda x: torch.einsum("...ij,...kj->...ik", x, x),
    "einsum, outer": lambda x: torch.einsum("bij,bk->ijk", x, x[:, :, 0]),
    "einsum of three": lambda x: torch.einsum("bij,cij,bkj->ck", x, x.sin(), x),
    "matmul, broadcast": lambda x: torch.matmul(x[:, None], x.mT[None]),
    "matmul of vectors": lambda x: x @ x[0, 1] + (x[1, :, 0] @ x[1]).sum() + x[0, 0] @ x[0, 1],
    "bmm, baddbmm": lambda x: torch.baddbmm(x, torch.bmm(x, x.mT), x, beta=0.5, alpha=2.0),
    "mm, addmm": lambda x: torch.addmm(x[0], x[0].mm(x[1].T), x[1], beta=0.3),
    "mv, dot, addmv": lambda x: x[0].mv(x[1, 1]).dot(x[1, :, 0]) + x[0, :, 0].addmv(x[0], x[1, 1]),
    "outer, addr": lambda x: x[0].addr(x[1, :, 0], x[1, 0]) @ torch.outer(x[0, 0], x[1, :, 1]),
    "kron": lambda x: torch.kron(x[0, :2, :1], x[1]),
    "chain of matrices": lambda x: torch.linalg.multi_dot([x[0], x[1].T, x[0]]) + x[0, :2].matrix_power(3).sum(),
    "norms of vectors": lambda x: torch.stack([x.norm(p=p, dim=-1) for p in (1, 2, 3, 0.5, math.inf, -math.inf)]),
    "norms of matrices": lambda x: torch.cat([torch.linalg.matrix_norm(x), x.norm()[None], x.norm(p=4, dim=(0, 1))]),
    "cosine_similarity": lambda x: F.cosine_similarity(x[0], x[1], dim=-1),
    "cdist, pairwise_distance": lambda x: torch.cdist(x[:1], x[1:]) + F.pairwise_distance(x[0], x[1]),
    "logsumexp": lambda x: torch.logsumexp(x, (0, 2)) + x.logsumexp(1, keepdim=True).sum(),
    "logaddexp": lambda x: torch.logaddexp(x[0], x[1]) + torch.logaddexp2(x[1], x.sin()),
    "logcumsumexp": lambda x: x.logcumsumexp(1),
    "softmax over points": lambda x: x.softmax(0) * x.log_softmax(1) + F.softmax(x.flatten(), 0).view_as(x),
    "mean and sum": lambda x: x.mean((0, 2)) + x.sum(1, keepdim=True).sum() * x.mean() - x.sum((0, 1, 2)),
    "var and std": lambda x: torch.cat([x.var(1), x.std(-2, unbiased=False), x.var((0, 1), correction=0)[None]]),
    "var_mean": lambda x: torch.stack(torch.var_mean(x)) + x.std(),
    "prod": lambda x: torch.cat([x.prod(1).flatten(), x[0].prod()[None]]),
    "cumsum, cumprod, diff": lambda x: x.cumsum(1).cumsum(0) + x.cumprod(1) - x.diff(dim=1, prepend=x[:, :1]),
    "amax and amin": lambda x: x.amax((0, 2)) - x.amin(1, keepdim=True).sum(-1) * x.max() + x.min(),
    "max and min with dimension": lambda x: x.max(1).values + x.min(0)[0][:2] + x.aminmax(dim=1).max,
}

# Layers: what they give becomes two outputs

LAYERS: dict[str, tuple] = {
    "Linear without bias on sequences": (lambda: nn.Linear(3, 2, bias=False), (1, 2, 3)),
    "Bilinear": (lambda: nn.Bilinear(3, 2, 2), (1, 3), (1, 2)),
    "Conv1d": (lambda: nn.Conv1d(2, 3, 3), (1, 2, 6)),
    "Conv1d stride, padding, dilation": (lambda: nn.Conv1d(2, 3, 3, 2, padding=2, dilation=2), (1, 2, 7)),
    "Conv1d depthwise": (lambda: nn.Conv1d(3, 6, 2, groups=3, bias=False), (1, 3, 4)),
    "Conv1d circular": (lambda: nn.Conv1d(2, 2, 3, padding=1, padding_mode="circular"), (1, 2, 5)),
    "Conv1d reflect": (lambda: nn.Conv1d(2, 2, 3, padding=2, padding_mode="reflect"), (1, 2, 5)),
    "Conv1d without batch": (lambda: nn.Sequential(nn.Conv1d(2, 2, 3), nn.Flatten(0), nn.Unflatten(0, (1, 6))), (2, 5)),
    "Conv2d": (lambda: nn.Conv2d(1, 2, 3), (1, 1, 4, 5)),
    "Conv2d stride and padding": (lambda: nn.Conv2d(2, 3, 3, stride=2, padding=1), (1, 2, 3, 4)),
    "Conv2d unequal": (lambda: nn.Conv2d(1, 2, (2, 3), (1, 2), (1, 0), (2, 1)), (1, 1, 4, 5)),
    "Conv2d groups": (lambda: nn.Conv2d(4, 2, 2, groups=2), (1, 4, 2, 3)),
    "Conv2d circular": (lambda: nn.Conv2d(1, 2, 3, padding=(1, 2), padding_mode="circular"), (1, 1, 3, 3)),
    "Conv3d stride and padding": (lambda: nn.Conv3d(2, 2, (1, 2, 2), (1, 2, 1), (0, 1, 0)), (1, 2, 2, 2, 3)),
    "ConvTranspose1d": (lambda: nn.ConvTranspose1d(2, 3, 3), (1, 2, 4)),
    "ConvTranspose1d stride, dilation": (lambda: nn.ConvTranspose1d(2, 2, 3, 2, 1, 1, dilation=2), (1, 2, 4)),
    "ConvTranspose2d": (lambda: nn.ConvTranspose2d(2, 1, 2, stride=2), (1, 2, 2, 3)),
    "ConvTranspose2d groups": (lambda: nn.ConvTranspose2d(2, 4, (2, 3), 1, (0, 1), groups=2), (1, 2, 2, 3)),
    "causal convolution": of(lambda m, x: m.c(F.pad(x, (2, 0))), (1, 2, 5), c=lambda: nn.Conv1d(2, 2, 2, dilation=2)),
    "convolution by the input": of(lambda m, x, kernel: F.conv1d(x, kernel), (1, 2, 4), (2, 2, 2)),
    "LayerNorm": (lambda: nn.LayerNorm(5), (1, 5)),
    "LayerNorm without weights": (lambda: nn.LayerNorm(4, elementwise_affine=False, eps=1e-2), (2, 4)),
    "LayerNorm of two dimensions": (lambda: nn.LayerNorm((2, 3)), (1, 2, 2, 3)),
    "RMSNorm": (lambda: nn.RMSNorm(4), (1, 4)),
    "GroupNorm": (lambda: nn.GroupNorm(2, 4), (1, 4, 3)),
    "InstanceNorm1d": (lambda: nn.InstanceNorm1d(2, affine=True), (1, 2, 4)),
    "InstanceNorm2d": (lambda: trained(nn.InstanceNorm2d(2, 1e-5, 0.1, True, True), shape=(2, 2, 3)), (1, 2, 2, 3)),
    "BatchNorm1d": (lambda: trained(nn.Linear(3, 4), nn.BatchNorm1d(4), nn.ReLU(), shape=(3,)), (1, 3)),
    "BatchNorm1d on sequences": (lambda: trained(nn.BatchNorm1d(2), shape=(2, 4)), (1, 2, 4)),
    "BatchNorm1d without weights": (lambda: trained(nn.BatchNorm1d(4, affine=False), shape=(4,)), (1, 4)),
    "BatchNorm1d by the batch": (lambda: nn.BatchNorm1d(3, track_running_stats=False), (3, 3)),
    "BatchNorm2d": (lambda: trained(nn.Conv2d(1, 2, 2), nn.BatchNorm2d(2), nn.SiLU(), shape=(1, 3, 4)), (1, 1, 3, 4)),
    "LocalResponseNorm": (lambda: nn.LocalResponseNorm(3, alpha=0.5), (1, 4, 2)),
    "MaxPool1d": (lambda: nn.MaxPool1d(2), (1, 2, 6)),
    "MaxPool2d": (lambda: nn.MaxPool2d(2, 1, padding=1), (1, 2, 2, 3)),
    "MaxPool2d ceil": (lambda: nn.MaxPool2d((3, 2), ceil_mode=True), (1, 1, 4, 5)),
    "MaxPool3d": (lambda: nn.MaxPool3d((1, 2, 2)), (1, 1, 2, 2, 4)),
    "AvgPool1d": (lambda: nn.AvgPool1d(3, 2, padding=1), (1, 2, 6)),
    "AvgPool1d ceil": (lambda: nn.AvgPool1d(2, ceil_mode=True, count_include_pad=False), (1, 2, 5)),
    "AvgPool2d": (lambda: nn.AvgPool2d(2, 1, padding=1, count_include_pad=False), (1, 2, 2, 3)),
    "AvgPool2d divisor": (lambda: nn.AvgPool2d((2, 3), 2, ceil_mode=True, divisor_override=3), (1, 1, 3, 5)),
    "AvgPool3d": (lambda: nn.AvgPool3d(2, 1), (1, 1, 2, 3, 3)),
    "AdaptiveAvgPool1d": (lambda: nn.AdaptiveAvgPool1d(3), (1, 2, 5)),
    "AdaptiveAvgPool2d": (lambda: nn.AdaptiveAvgPool2d((2, 3)), (1, 1, 3, 5)),
    "AdaptiveAvgPool2d to one": (lambda: nn.Sequential(nn.Conv2d(1, 3, 2), nn.AdaptiveAvgPool2d(1)), (1, 1, 4, 4)),
    "AdaptiveMaxPool2d": (lambda: nn.AdaptiveMaxPool2d((2, 2)), (1, 1, 3, 5)),
    "LPPool1d": (lambda: nn.LPPool1d(2, 2), (1, 2, 6)),
    "LPPool2d": (lambda: nn.Sequential(nn.Softplus(), nn.LPPool2d(3, 2, stride=1)), (1, 1, 3, 4)),
    "Upsample nearest": (lambda: nn.Upsample(scale_factor=2), (1, 1, 2, 3)),
    "Upsample nearest-exact": (lambda: nn.Upsample(size=5, mode="nearest-exact"), (1, 2, 3)),
    "Upsample linear": (lambda: nn.Upsample(size=5, mode="linear"), (1, 2, 3)),
    "Upsample bilinear": (lambda: nn.Upsample(scale_factor=(2.0, 1.5), mode="bilinear"), (1, 1, 2, 4)),
    "Upsample bilinear, corners": (lambda: nn.Upsample((3, 5), mode="bilinear", align_corners=True), (1, 1, 2, 3)),
    "PixelShuffle": (lambda: nn.Sequential(nn.PixelShuffle(2), nn.Conv2d(1, 1, 2)), (1, 4, 2, 2)),
    "PixelUnshuffle": (lambda: nn.Sequential(nn.PixelUnshuffle(2), nn.Conv2d(4, 1, 2)), (1, 1, 4, 4)),
    "ChannelShuffle": (lambda: nn.Sequential(nn.ChannelShuffle(2), nn.Conv1d(4, 2, 2, groups=2)), (1, 4, 3)),
    "ZeroPad2d": (lambda: nn.Sequential(nn.ZeroPad2d((1, 0, 2, 1)), nn.Conv2d(1, 1, 2)), (1, 1, 2, 3)),
    "negative padding": (lambda: nn.ConstantPad1d((-1, 2), -0.4), (1, 2, 4)),
    "ReflectionPad1d": (lambda: nn.ReflectionPad1d((2, 1)), (1, 2, 4)),
    "ReflectionPad2d": (lambda: nn.ReflectionPad2d((1, 2, 0, 1)), (1, 1, 3, 3)),
    "ReplicationPad1d": (lambda: nn.ReplicationPad1d((1, 3)), (1, 2, 4)),
    "ReplicationPad2d": (lambda: nn.Sequential(nn.ReplicationPad2d(1), nn.MaxPool2d(2)), (1, 1, 3, 3)),
    "CircularPad1d": (lambda: nn.CircularPad1d((1, 2)), (1, 2, 4)),
    "Unfold": (lambda: nn.Unfold((2, 2), dilation=1, padding=1, stride=2), (1, 1, 3, 4)),
    "Fold": (lambda: nn.Fold((3, 3), (2, 2)), (1, 4, 4)),
    "Flatten and Unflatten": (lambda: nn.Sequential(nn.Flatten(), nn.Unflatten(1, (3, 2)), nn.SiLU()), (1, 2, 3)),
    "Dropout": (lambda: nn.Sequential(nn.Dropout(0.4), nn.AlphaDropout(0.2), nn.FeatureAlphaDropout()), (1, 3)),
    "index buffers": of(lambda m, x: x[:, m.i, m.i % 2] * x[:, m.i].mean(2), (1, 3, 2), i=tensor([2, 0, -1])),
    "index_select, gather": of(lambda m, x: x.index_select(1, m.i[0]) * x.gather(1, m.i), (1, 4), i=tensor([[3, 1]])),
    "mask buffer": of(lambda m, x: x[:, m.on].square(), (1, 4), on=tensor([True, False, True, False])),
    "masked_fill": of(lambda m, x: x.masked_fill(m.on, 0.3), (1, 4), on=tensor([True, False, True, False])),
    "index_put": of(lambda m, x: x.new_zeros(4).index_put((m.i,), x[0, :2])[None], (1, 3), i=tensor([3, 1])),
    "index_add": of(lambda m, x: x.new_zeros(1, 3).index_add(1, m.i, x), (1, 4), i=tensor([2, 0, 2, 1])),
    "scatter_add": of(lambda m, x: x.new_zeros(1, 3).scatter_add(1, m.i, x.sin()), (1, 4), i=tensor([[2, 0, 2, 1]])),
    "scatter": of(lambda m, x: torch.ones_like(x).scatter(1, m.i, x[:, 1:].square()), (1, 4), i=tensor([[2, 0, 3]])),
    "limits": of(lambda m, x: torch.clamp(x, -m.top, m.top) * x, (1, 3), top=tensor([0.5, 1.0, 2.0])),
    "learned exponents": of(lambda m, x: F.softplus(x) ** m.a, (1, 2), a=param(2)),
    "MultiheadAttention": of(lambda m, x: m.a(x, x, x, need_weights=False)[0], (1, 3, 4), a=attention()),
    "MultiheadAttention causal": of(lambda m, x: m.a(x, x, x, attn_mask=m.no)[0], (1, 3, 4), a=attention(), no=CAUSAL),
    "MultiheadAttention -inf": of(lambda m, x: m.a(x, x, x, None, False, m.no)[0], (1, 3, 4), a=attention(), no=MINUS),
    "MultiheadAttention, weights": of(lambda m, x: torch.cat(m.a(x, x, x), -1), (1, 3, 4), a=attention()),
    "MultiheadAttention, heads": of(lambda m, x: m.a(x, x, x, None, True, None, False)[1], (1, 3, 4), a=attention()),
    "MultiheadAttention across": of(lambda m, x, y: m.a(x, y, y)[0], (1, 2, 4), (1, 3, 3), a=attention(kdim=3, vdim=3)),
    "MultiheadAttention, bias": of(lambda m, x: m.a(x, x, x)[0], (1, 2, 4), a=attention(bias=False, add_bias_kv=True)),
    "MultiheadAttention, padding": of(lambda m, x: m.a(x, x, x, m.no[:1])[0], (1, 3, 4), a=attention(), no=CAUSAL),
    "scaled dot product": of(lambda m, q, k: attend(q, k, k.tanh(), scale=0.7), (1, 2, 4), (1, 3, 4)),
    "scaled dot product, causal": of(lambda m, x: attend(x, x.sin(), x, is_causal=True), (1, 2, 3, 2)),
    "scaled dot product, float mask": of(lambda m, x: attend(x, x.flip(1), x, m.mask), (1, 3, 4), mask=noise(3, 3)),
    "scaled dot product, mask": of(lambda m, x: attend(x, x, x, attn_mask=~m.no), (1, 1, 3, 4), no=CAUSAL),
    "scaled dot product, groups": of(lambda m, q, k: attend(q, k, k, enable_gqa=True), (1, 4, 2, 2), (1, 2, 2, 2)),
    "TransformerEncoderLayer": (transformer(ENCODER), (1, 3, 4)),
    "TransformerEncoderLayer norm first": (transformer(ENCODER, norm_first=True), (1, 3, 4)),
    "TransformerEncoderLayer GELU": (transformer(ENCODER, activation="gelu", norm_first=True), (1, 3, 4)),
    "TransformerEncoder": (lambda: nn.TransformerEncoder(transformer(ENCODER)(), 2, nn.LayerNorm(4)), (1, 3, 4)),
    "TransformerDecoderLayer": (transformer(nn.TransformerDecoderLayer), (1, 2, 4), (1, 3, 4)),
    "Transformer": (lambda: nn.Transformer(4, 2, 1, 1, 5, norm_first=True, batch_first=True), (1, 3, 4), (1, 2, 4)),
    "learned queries": of(lambda m, x: m.a(m.queries, x, x)[0], (1, 3, 4), a=attention(), queries=param(1, 2, 4)),
    "squeeze and excitation": of(lambda m, x: x * m.gate(x.mean(2)).sigmoid()[..., None], (1, 3, 3), gate=(3, 2, 3)),
    "MLP mixer": of(lambda m, x: x + m.rows(x.mT).mT + m.columns(x), (1, 3, 2), rows=(3, 4, 3), columns=(2, 3, 2)),
    "linear splines": of(lambda m, x: F.relu(1 - (x[..., None] - m.k).abs()), (1, 2), k=torch.arange(-2.0, 3.0)),
    "sines of positions": of(lambda m, x: m.f(x + m.table[: x.size(1)].sin()), (1, 3, 2), f=(2, 2), table=noise(5, 2)),
    "Fourier features": of(lambda m, x: torch.cat([(x @ m.w).sin(), (x @ m.w).cos()], -1), (1, 2), w=noise(2, 3)),
    "weight_norm of a convolution": (lambda: weight_norm(nn.Conv1d(2, 3, 2)), (1, 2, 4)),
    "spectral_norm": (lambda: spectral_norm(nn.Linear(3, 4)), (1, 3)),
    "orthogonal": (lambda: orthogonal(nn.Linear(3, 3)), (1, 3)),
    "orthogonal by Cayley": (lambda: orthogonal(nn.Linear(3, 3), orthogonal_map="cayley"), (1, 3)),
    "orthogonal by reflections": (lambda: orthogonal(nn.Linear(3, 2), orthogonal_map="householder"), (1, 3)),
    "symmetric weight": (lambda: register(nn.Linear(3, 3), "weight", Of(lambda m, w: w.triu() + w.triu(1).mT)), (1, 3)),
    "positive weight": (lambda: register(nn.Linear(3, 3), "weight", nn.Softplus()), (1, 3)),
}


def sinkhorn(x: Tensor) -> Tensor:
    for _ in range(3):
        x = x - x.logsumexp(-1, keepdim=True)
        x = x - torch.logsumexp(x, dim=-2, keepdim=True)
    return x.exp()


def assigned(x: Tensor) -> Tensor:
    y = x.clone()
    y[1] = x[0] * x[2]
    y[2:4] *= 2.0
    y[::4] += x[1:4].sin()
    return y.clamp_(max=1.5)


# Networks: as they are

NETWORKS: dict[str, tuple] = {
    "Linear": (lambda: nn.Linear(3, 2), (1, 3)),
    "perceptron": (lambda: mlp(3, 6, 6, 2), (1, 3)),
    "perceptron without batch": (lambda: mlp(3, 4, 2), (3,)),
    "perceptron, batch of three": (lambda: mlp(3, 4, 2), (3, 3)),
    "casts": of(lambda m, x: m.f(x.to(m.f[0].weight.dtype)).type_as(m.f[2].bias), (1, 3), f=(3, 4, 2)),
    "RNNCell": (lambda: nn.RNNCell(3, 2), (1, 3), (1, 2)),
    "GRUCell": (lambda: nn.GRUCell(3, 2), (1, 3), (1, 2)),
    "LSTMCell": of(lambda m, x, h, c: m.cell(x, (h, c)), (1, 3), (1, 2), (1, 2), cell=lambda: nn.LSTMCell(3, 2)),
    "RNN": of(lambda m, x: m.rnn(x)[1], (1, 3, 3), rnn=lambda: nn.RNN(3, 2, batch_first=True)),
    "RNN ReLU, two layers": of(lambda m, x: m.rnn(x)[0][-1], (3, 1, 2), rnn=lambda: nn.RNN(2, 2, 2, "relu")),
    "GRU": of(lambda m, x: m.rnn(x)[0][:, -1], (1, 3, 3), rnn=lambda: nn.GRU(3, 2, batch_first=True)),
    "GRU with state": of(lambda m, x, h: m.rnn(x, h)[1][0], (2, 1, 3), (1, 1, 2), rnn=lambda: nn.GRU(3, 2)),
    "GRU without batch": of(lambda m, x: m.rnn(x)[1][0], (3, 2), rnn=lambda: nn.GRU(2, 2)),
    "GRU bidirectional": of(lambda m, x: m.rnn(x)[0][-1], (3, 1, 2), rnn=lambda: nn.GRU(2, 2, 2, bidirectional=True)),
    "LSTM": of(lambda m, x: m.rnn(x)[0][:, -1], (1, 3, 3), rnn=lambda: nn.LSTM(3, 2, 2, batch_first=True, dropout=0.5)),
    "LSTM bidirectional": of(lambda m, x: m.rnn(x)[1][0], (3, 1, 2), rnn=lambda: nn.LSTM(2, 2, bidirectional=True)),
    "LSTM with projection": of(lambda m, x: m.rnn(x)[0].sum(0), (3, 1, 2), rnn=lambda: nn.LSTM(2, 3, proj_size=1)),
    "LSTM with states": of(lambda m, x, *hc: m.f(x, hc)[1], (2, 1, 2), (1, 1, 2), (1, 1, 2), f=lambda: nn.LSTM(2, 2)),
    "residual block": of(lambda m, x: x + m.f(m.norm(x)), (1, 3), f=(3, 4, 3), norm=lambda: nn.LayerNorm(3)),
    "autoencoder": (lambda: nn.Sequential(nn.Flatten(), mlp(6, 2, 6), nn.Unflatten(1, (2, 3))), (1, 2, 3)),
    "scaled inputs, outputs": of(lambda m, x: m.f((x - m.a) / m.b) * m.a, (1, 3), f=(3, 4, 3), a=noise(3), b=noise(3)),
    "modulated features": of(lambda m, x, z: m.f(x) * m.a(z) + m.b(z), (1, 3), (1, 2), f=(3, 2), a=(2, 2), b=(2, 2)),
    "ensemble": of(lambda m, x: torch.std_mean(torch.stack([m.a(x), m.b(x)]), 0), (1, 3), a=(3, 4, 2), b=(3, 4, 2)),
    "squashed policy": of(lambda m, x: (2.0 * m.a(x).tanh(), m.b(x).clamp(-5, 2).exp()), (1, 4), a=(4, 5, 2), b=(4, 2)),
    "hypernetwork": of(lambda m, x, z: torch.bmm(m.w(z).view(-1, 2, 3), x[..., None]), (1, 3), (1, 2), w=(2, 4, 6)),
    "functional_call": of(lambda m, x, w: functional_call(m.f, {"0.weight": w}, x), (1, 3), (2, 3), f=(3, 2)),
    "vmap": of(lambda m, x: torch.vmap(lambda w: (x @ w).tanh())(m.w).mean(0), (1, 3), w=param(3, 3, 2)),
    "deep sets": of(lambda m, x: m.rho(m.phi(x).sum(1)), (1, 4, 2), phi=(2, 4, 3), rho=(3, 4, 2)),
    "point net": of(lambda m, x: m.head(m.points(x).max(dim=1)[0]), (1, 4, 3), points=(3, 4, 4), head=(4, 2)),
    "radial basis": of(lambda m, x: (-(x - m.c).square().sum(1)).exp() @ m.w, (1, 3), c=noise(5, 3), w=param(5)),
    "Kolmogorov-Arnold": of(lambda m, x: F.relu(x.mT - m.k).pow(3).flatten() @ m.w, (1, 3), w=param(12, 2), k=noise(4)),
    "siamese": of(lambda m, x, y: F.cosine_similarity(m.f(x), m.f(y)), (1, 3), (1, 3), f=(3, 4, 3)),
    "dense connections": of(lambda m, x: m.b(torch.cat([x, m.a(x).relu()], dim=1)), (1, 3), a=(3, 2), b=(5, 2)),
    "Euler steps": of(lambda m, x: reduce(lambda y, _: y + 0.1 * m.f(y), range(4), x), (1, 2), f=(2, 4, 2)),
    "losses": of(lambda m, x, y: F.mse_loss(x, y) + F.huber_loss(x, y) + F.smooth_l1_loss(x, y), (1, 3), (1, 3)),
    "tuple of outputs": of(lambda m, x: (m.a(x), m.b(x).tanh()), (1, 3), a=(3, 3, 2), b=(3, 1)),
    "dictionary of outputs": of(lambda m, x: {"y": m.a(x), "z": F.softplus(m.b(x)) + 1e-3}, (1, 3), a=(3, 2), b=(3, 2)),
    "nested outputs": of(lambda m, x: ({"y": m.a(x)}, [x.square(), (x[:, 0],)]), (1, 2), a=(2, 1)),
    "scalar output": of(lambda m, x: m.f(x).square().sum(), (1, 3), f=(3, 4, 2)),
    "three inputs": of(lambda m, x, u, p: m.f(x) * p + (u * u).sum(-1, True), (1, 3), (1, 2), (1, 1), f=(3, 2)),
    "tied weights": of(lambda m, x: F.linear(m.f(x).tanh(), m.f[0].weight.t(), m.b), (1, 3), f=(3, 2), b=param(3)),
    "weight in two layers": (lambda: tied(mlp(3, 3, 3)), (1, 3)),
    "module used twice": of(lambda m, x: m.f(m.f(x).relu()) + m.f(x), (1, 3), f=(3, 3)),
    "hooks": (lambda: hooked(mlp(3, 4, 2)), (1, 3)),
    "choice by size": of(lambda m, x: m.f(x) if x.shape[1] > 2 and not m.training else x.sort(), (1, 3), f=(3, 2)),
    "plain attribute": of(lambda m, x: m.f(x / m.scale[0]), (1, 3), f=(3, 2), scale=[tensor([0.5, 2.0, 4.0])]),
    "Embedding of a constant": of(lambda m, x: x * m.e(m.i), (1, 3), e=lambda: nn.Embedding(4, 3), i=tensor([2])),
    "one_hot of a constant": of(lambda m, x: m.f(x + F.one_hot(m.i, 3)), (1, 3), f=(3, 4, 2), i=tensor([2])),
    "weight_norm": (lambda: weight_norm(nn.Linear(3, 4), dim=None), (1, 3)),
    "bilinear form": of(lambda m, x, y: torch.einsum("bi,kij,bj->bk", x, m.w, y), (1, 3), (1, 2), w=param(2, 3, 2)),
    "positive definite": of(lambda m, x: (x @ m.l.tril()).square().sum() + x.square().sum(), (1, 3), l=param(3, 3)),
    "Lyapunov function": of(lambda m, x: F.relu(m.v(x) - m.v(torch.zeros_like(x))) + (x * x).sum(-1), (1, 2), v=(2, 1)),
    "planar arm": of(lambda m, q: torch.stack([q.cumsum(1).cos(), q.cumsum(1).sin()]) @ m.l, (1, 3), l=noise(3)),
    "friction": of(lambda m, v: -(0.1 + torch.exp(-((v / 0.5) ** 2))) * (v / 0.1).tanh() - m.d * v, (1, 2), d=param()),
    "heading, range": of(lambda m, x, y: (torch.atan2(*(y - x).unbind(-1)), (y - x).norm(dim=-1)), (1, 2), (1, 2)),
}


def network(*shapes: tuple[int, ...], **parts: Any) -> Callable[[Callable], Callable]:
    """Into the collection, under the function's name."""

    def collect(function: Callable) -> Callable:
        NETWORKS[function.__name__.replace("_", " ")] = of(function, *shapes, **parts)
        return function

    return collect


def tied(module: nn.Sequential) -> nn.Module:
    module[2].weight = module[0].weight
    return module


def hooked(module: nn.Sequential) -> nn.Module:
    module.register_forward_pre_hook(lambda m, args: (args[0] / 2,))
    module[0].register_forward_hook(lambda m, args, y: y.sin())
    return module


@network((1, 3, 4), qkv=(4, 12), out=(4, 1), no=CAUSAL)
def attention_by_hand(m, x):
    q, k, v = (y.unflatten(-1, (2, 2)).transpose(1, 2) for y in m.qkv(x).chunk(3, dim=-1))
    scores = torch.matmul(q, k.transpose(-2, -1)) / math.sqrt(q.size(-1))
    weights = F.softmax(scores.masked_fill(m.no, float("-inf")), dim=-1)
    return m.out((weights @ v).transpose(1, 2).contiguous().view(x.shape)).squeeze(-1)


@network((1, 3), gate=(3, 3), experts=lambda: nn.ModuleList([mlp(3, 4, 2) for _ in range(3)]))
def mixture_of_experts(m, x):
    return torch.einsum("be,beo->bo", m.gate(x).softmax(-1), torch.stack([e(x) for e in m.experts], 1))


@network((3, 2), message=(4, 3), update=lambda: nn.GRUCell(3, 2), edges=tensor([[0, 1, 2, 0], [1, 2, 0, 2]]))
def graph_network(m, x):
    source, target = m.edges
    for _ in range(2):
        messages = m.message(torch.cat([x[source], x[target]], dim=-1))
        x = m.update(torch.zeros(3, 3).to(x).index_add(0, target, messages), x)
    return x


@network((1, 3), body=(3, 5), logits=(5, 3), means=(5, 3), deviations=(5, 3))
def mixture_density(m, x):
    y = m.body(x)
    weights, means, variances = m.logits(y).softmax(-1), m.means(y), m.deviations(y).clamp(-3, 3).exp() ** 2
    mean = (weights * means).sum(-1)
    return mean, torch.sqrt((weights * (variances + means**2)).sum(-1) - mean**2)


@network(
    (1, 2),
    blocks=lambda: nn.ModuleDict({"left": mlp(2, 3), "right": nn.ModuleList([nn.Linear(2, 3), nn.ReLU()])}),
    gains=lambda: nn.ParameterDict({"left": param(3)(), "right": param(1)()}),
)
def containers(m, x):
    y = m.blocks["left"](x) * m.gains["left"]
    for layer in m.blocks["right"]:
        x = layer(x)
    return (x + y) * m.gains["right"]


@network((1, 3, 2), encoder=lambda: nn.LSTM(2, 3, batch_first=True), cell=lambda: nn.GRUCell(1, 3), out=(3, 1))
def encoder_and_decoder(m, x):
    zeros = torch.zeros(1, x.shape[0], 3, dtype=x.dtype, device=x.device)
    h, y = m.encoder(x, (zeros, torch.zeros(1, x.size(0), 3).to(x)))[1][0][0], x[:, -1, :1]
    for _ in range(3):
        h = m.cell(y, h)
        y = y + m.out(h)
    return y


@network((1, 2), (1, 1), net=(3, 4, 1), gravity=tensor(9.81), damping=param())
def pendulum_with_residual(m, x, u):
    angle, rate = x.unbind(-1)
    known = u[:, 0] - m.gravity * angle.sin() - m.damping.abs() * rate
    acceleration = known + m.net(torch.stack([angle.sin(), angle.cos(), rate], -1)).squeeze(-1)
    rate = rate + 0.05 * acceleration
    return torch.stack((angle + 0.05 * rate, rate), dim=-1)


@network((1, 3), (1, 3), net=(3, 5, 6), index=torch.tril_indices(3, 3))
def kinetic_energy(m, q, v):
    factor = q.new_zeros(q.shape[0], 3, 3)
    factor[:, m.index[0], m.index[1]] = m.net(q)
    diagonal = torch.diagonal(factor, dim1=-2, dim2=-1)
    factor = factor - torch.diag_embed(diagonal) + torch.diag_embed(F.softplus(diagonal) + 0.1)
    return 0.5 * torch.einsum("bi,bij,bj->b", v, factor @ factor.mT, v)


@network((1, 4), points=noise(2, 3))
def points_turned_by_quaternion(m, q):
    q = F.normalize(q, dim=-1)
    axis, points = q[:, None, 1:].expand(-1, 2, -1), m.points.expand(q.shape[0], -1, -1)
    t = 2.0 * torch.cross(axis, points, dim=-1)
    return points + q[:, :1, None] * t + torch.linalg.cross(axis, t)


@network((1, 3), lengths=noise(3))
def transforms_along_a_chain(m, q):
    pose = torch.eye(3).to(q)
    for i in range(3):
        step = torch.zeros(3, 3, dtype=q.dtype)
        step[0, 0] = step[1, 1] = q[0, i].cos()
        step[1, 0], step[0, 1] = q[0, i].sin(), -q[0, i].sin()
        step[0, 2], step[2, 2] = m.lengths[i], 1.0
        pose = pose @ step
    return pose[:2, 2]


ROWS: dict[str, tuple] = {
    **{name: between(layer) for name, layer in ACTIVATIONS.items()},
    **{name: between(partial(Of, function)) for name, function in FEATURES.items()},
    **{name: matrices(function) for name, function in MATRICES.items()},
    **{name: headed(*row) for name, row in LAYERS.items()},
    **NETWORKS,
}

MODULES: list[Entry] = [
    Entry(name, seeded(build, tuple(shapes)), tuple(shapes)) for name, (build, *shapes) in ROWS.items()
]

# What no expression can hold: in the place of body.1, except where another path is given


@torch.library.custom_op("torch_zoo::double", mutates_args=())
def double(x: Tensor) -> Tensor:
    return 2.0 * x


double.register_fake(torch.empty_like)


def halved(_: nn.Module, x: Tensor) -> Tensor:
    while x.norm() > 1.0:
        x = x / 2
    return x


def counted(m: nn.Module, x: Tensor) -> Tensor:
    m.steps += 1
    return x * m.steps


def energy_slope(m: nn.Module, x: Tensor) -> Tensor:
    return torch.func.grad(lambda y: m.f(y).sum())(x)


def slope(m: nn.Module, x: Tensor) -> Tensor:
    with torch.enable_grad():
        y = x.detach().requires_grad_()
        return torch.autograd.grad(m.f(y).sum(), y, create_graph=True)[0]


def fed(m: nn.Module, x: Tensor) -> Tensor:
    return F.batch_norm(x.view(2, 2), m.mean, m.variance, training=True).view(1, 4)


def inside(build: Callable[[], nn.Module]) -> Callable[[], nn.Module]:
    return lambda: nn.Sequential(OrderedDict(body=nn.Sequential(nn.Linear(3, 4), build()), head=nn.Linear(4, 2)))


TROUBLES: dict[str, tuple[Callable[[], nn.Module], str]] = {
    "if": (partial(Of, lambda m, x: x.sin() if x.sum() > 0 else x.cos()), "value"),
    "while": (partial(Of, halved), "value"),
    "item": (partial(Of, lambda m, x: x * x.max().item()), "value"),
    "float": (partial(Of, lambda m, x: x * float(x[0, 0])), "value"),
    "numpy": (partial(Of, lambda m, x: x * x.detach().numpy().max()), "numpy"),
    "cond": (partial(Of, lambda m, x: torch.cond(x.sum() > 0, torch.sin, torch.cos, (x,))), "cond"),
    "sort": (partial(Of, lambda m, x: x.sort(dim=1).values), "sort"),
    "topk": (partial(Of, lambda m, x: x.topk(2).values.repeat(1, 2)), "topk"),
    "median": (partial(Of, lambda m, x: x - x.median(dim=1, keepdim=True).values), "median"),
    "argmax": (partial(Of, lambda m, x: x * x[:, x.argmax()]), "argmax"),
    "nonzero": (partial(Of, lambda m, x: x * x.flatten()[x.flatten().nonzero()].mean()), "nonzero"),
    "selection by a condition": (partial(Of, lambda m, x: x * x[x > 0].sum()), "index"),
    "table looked up": (partial(Of, lambda m, x: m.table[x.clamp(0, 3).long()[0]][None], table=noise(4)), "int64"),
    "embedding": (partial(Of, lambda m, x: m.e(x[:, 0].long().clamp(0, 3)), e=lambda: nn.Embedding(4, 4)), "embedding"),
    "rand": (partial(Of, lambda m, x: x + torch.rand(4)), "rand"),
    "randn": (partial(Of, lambda m, x: x + 0.1 * torch.randn_like(x)), "randn"),
    "active dropout": (partial(Of, lambda m, x: F.dropout(x, 0.3, training=True)), "dropout"),
    "FFT": (partial(Of, lambda m, x: torch.fft.rfft(x, n=6).abs()), "fft"),
    "complex numbers": (partial(Of, lambda m, x: torch.polar(x, x.sin()).angle()), "polar"),
    "step counter": (partial(Of, counted, steps=torch.zeros(())), "steps"),
    "statistics that go on": (partial(Of, fed, mean=torch.zeros(2), variance=torch.ones(2)), "mean"),
    "custom operator": (partial(Of, lambda m, x: double(x)), "double"),
    "lazy layer never called": (lambda: nn.LazyLinear(4), "lazy"),
    "solve": (partial(Of, lambda m, x: torch.linalg.solve(torch.eye(4) + x.T @ x, x[0])[None]), "solve"),
    "eigenvalues": (partial(Of, lambda m, x: torch.linalg.eigvalsh(torch.diag(x[0]) + 1.0)[None]), "eig"),
}

REFUSED: list[Refusal] = [
    *(Refusal(name, seeded(inside(build)), ((1, 3),), "body.1", says) for name, (build, says) in TROUBLES.items()),
    Refusal("derivative", seeded(inside(partial(Of, energy_slope, f=partial(mlp, 4, 1)))), ((1, 3),), "", "derivative"),
    Refusal(
        "derivative by autograd", seeded(inside(partial(Of, slope, f=partial(mlp, 4, 1)))), ((1, 3),), "", "derivative"
    ),
    Refusal("if of the root", seeded(partial(Of, lambda m, x: -x if x[0, 0] > 0 else x)), ((1, 3),), "", "value"),
    Refusal("TorchScript", seeded(lambda: torch.jit.script(nn.Linear(3, 2))), ((1, 3),), "", "TorchScript"),
]
