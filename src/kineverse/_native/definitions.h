/* How functions are compiled, and the type of functions that are compiled from expressions. */
#pragma once

#define EXPORTED __attribute__((visibility("default")))
#define UNUSED __attribute__((unused))
#define INLINE static inline __attribute__((always_inline, unused))

/* Inputs, outputs, and what CasADi's convention has besides: work arrays and a memory index, which none needs. */
typedef int (*Function)(const double **, double **, long long *, double *, int);
