"""The elementary functions a document may use, under names that do not depend on CasADi's numbering."""

from __future__ import annotations

import casadi as ca

UNARY: dict[str, int] = {
    "neg": ca.OP_NEG,
    "exp": ca.OP_EXP,
    "log": ca.OP_LOG,
    "expm1": ca.OP_EXPM1,
    "log1p": ca.OP_LOG1P,
    "sqrt": ca.OP_SQRT,
    "square": ca.OP_SQ,
    "twice": ca.OP_TWICE,
    "inv": ca.OP_INV,
    "sin": ca.OP_SIN,
    "cos": ca.OP_COS,
    "tan": ca.OP_TAN,
    "arcsin": ca.OP_ASIN,
    "arccos": ca.OP_ACOS,
    "arctan": ca.OP_ATAN,
    "sinh": ca.OP_SINH,
    "cosh": ca.OP_COSH,
    "tanh": ca.OP_TANH,
    "arcsinh": ca.OP_ASINH,
    "arccosh": ca.OP_ACOSH,
    "arctanh": ca.OP_ATANH,
    "erf": ca.OP_ERF,
    "abs": ca.OP_FABS,
    "sign": ca.OP_SIGN,
    "floor": ca.OP_FLOOR,
    "ceil": ca.OP_CEIL,
    "not": ca.OP_NOT,
}

BINARY: dict[str, int] = {
    "add": ca.OP_ADD,
    "sub": ca.OP_SUB,
    "mul": ca.OP_MUL,
    "div": ca.OP_DIV,
    "pow": ca.OP_POW,
    "constpow": ca.OP_CONSTPOW,
    "arctan2": ca.OP_ATAN2,
    "hypot": ca.OP_HYPOT,
    "copysign": ca.OP_COPYSIGN,
    "fmod": ca.OP_FMOD,
    "remainder": ca.OP_REMAINDER,
    "min": ca.OP_FMIN,
    "max": ca.OP_FMAX,
    "lt": ca.OP_LT,
    "le": ca.OP_LE,
    "eq": ca.OP_EQ,
    "ne": ca.OP_NE,
    "and": ca.OP_AND,
    "or": ca.OP_OR,
    # b where a holds, else 0, even if b is NaN.
    "if_else_zero": ca.OP_IF_ELSE_ZERO,
}

NAMES: dict[int, str] = {code: name for name, code in (*UNARY.items(), *BINARY.items())}
