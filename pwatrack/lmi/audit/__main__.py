"""Check a pwatrack certificate with fractions only: python audit certificate.json .

This folder runs alone, on Python's standard library, wherever it is copied to. Read it from certificate.py on.

Nothing is taken from the file but the plant, the gains and the proofs; all between them is worked out again. An object
has the keys of `reading.py` and no others, each once, and by its keys a proof is one claim; a number is written in one
way. Steps are counted, longer numbers as more of them: a file that asks for more than its size is worth is refused.

- The cells cover R^n without overlap, and the field is continuous: no two hyperplanes are one, and two cells on
  opposite sides of H x + h = 0 alone have [A_i b_i] - [A_j b_j] = g [H h], or do not touch there. Linear programs in
  fractions decide the geometry. Where entries lie in balls, this and what is said of (11) are about their centres.
- Or no cell is listed, and the field is A x + b + B u and the sum of direction f(row x + constant), each f continuous
  and linear between breakpoints. The rows are independent, so all combinations of segments are cells. Each A_i is a
  mean of those at the corners of the box of slopes: A + the sum of slope direction row, each slope the least or the
  largest of its f. All that is decided here is affine in A_i, as T has to be the same in all cells: so it is decided
  at these corners.
- The normal form (11): c_0 is a tracked row, c_k+1 = c_k A_i, the same in all cells but for the last one, and c_k B = 0
  for k < r - 1. With C the last rows of all outputs, Z the directions of the inputs and D = C B Z of each cell,
  sym(S D M S^-1) > 0 for M the inverse of the mean of all D and S the scales: no matrix in the hull of the D is
  singular. N = e_j - (B Z D_1^-1)_j C_1 for the internal states j give T_i = [c; N], and A_eta_i is the lower right
  part of T_i A_i T_i^-1.
- A design has P_jk = integers_jk * 2**(exponents_j + exponents_k), P > 0 and -(M_i P + P M_i^T) - 2 rate P - margin I
  > 0 for every i: so every x' = A(t) x with A(t) in the convex hull of the M_i, or of their transposes, decays at least
  as fast as exp(-rate t). M_i is A_i + B K for (8), (A_i + L C)^T for (9), A_eta_i^T for (17). Where entries lie in
  balls, this and all that follows but the last holds for everything in them.
- In place of that P a polynomial of degree 2 d may stand: V = m^T P m, m the monomials of degree d of z = T e, P > 0.
  Along e' = X_i e, X_i the M_i that is not transposed, m' = F_i m, and F_i is linear in X_i. With -(P F_i + F_i^T P) -
  2 d rate P - N_i > 0 and m^T N_i m = 0 for all z, V' < -2 d rate V for all X(t) in the convex hull: so e decays at
  least as fast as exp(-rate t).
- A bound has Q > 0 and -(M Q + Q M^T) - a Q - g g^T / a > 0 for M = [A_i + B K, B K; 0, A_j + L C] and all i, j, or for
  one of its diagonal blocks: so from z = 0 on, z' = M z + g d stays where z^T Q^-1 z <= sup |d|^2, and |c z| is at
  most (c Q c^T)^(1/2) sup |d|. z = (e, Delta) = (x - x_d, x_hat - x); g and c are those of the channel and the signal.
- Limits of inputs have starts z(0) = G v, |v_k| <= 1, and weights w > 0 with sum at most 1: Q > 0, Q - G diag(1/w) G^T
  > 0 and -(M Q + Q M^T) > 0, so z^T Q^-1 z <= 1 at the start, by Cauchy and Schwarz, and from there on, and |c z| is at
  most (c Q c^T)^(1/2). With loads and z = e they are 0, and their estimates too; with z = (e, Delta) they are constants
  at inputs, and c is that of K (e + Delta) less the errors of their estimates.
- A bound of a start has Q - G G^T > 0 and -(M Q + Q M^T) - a Q > 0: |c z| is at most (c Q c^T)^(1/2) at all times from
  z = G v on, |v| <= 1. G is a column of the identity, of a sinusoidal load the two of its states.
- Loads E s with s' = S s are estimated: then [A_i, E; 0, S] and [C, 0] stand for A_i and C in (9), Delta has the errors
  of the estimates below x_hat - x, and [B K - X L_s C, -E] stands for B K beside A_i + B K, by which noise reaches e
  too: L_s is the part of L that is below, and X = -T^-1 G, G = [g; 0], g_0 = 0, g_k+1 = c_k E + g_k S, the shift of x_d
  by the estimates; for state tracking X = 0, and every load enters where an input does.
- Uncertain parameters have corners: other A_c, b_c and B_c for the same cells, whose fields are continuous too. Their
  bounds are such bounds for M = [A_ci + B_c K, B_c K; A_i - A_ci - (B_c - B) K, A_j + L C - (B_c - B) K], all corners
  and all i, j; M is affine in A_c and B_c, so they hold for all means of the corners. g = (w, -w) with one entry of w;
  each entry in which a corner differs from the plant has its bounds.
- Practical tracking has a true plant with cells of its own, whose field in each of them, less direction f(row x +
  constant) for each merged element, is that of the plant less direction g(row x + constant), in all cells that may
  meet; |f - g| <= largest, as it is so at all breakpoints and the outer slopes are the same. The design is that of the
  plant, and g of a bound is (E, -E), E the direction of an element; or (E, 0) where the observer runs the true cells,
  which (9) is then about. A signal ends below the sum of largest times its bound. A bound of one matrix M may be
  a peak gain, the integral of |c exp(M t) g|, see peak_gain.py.
- A cost has X M_i + M_i^T X + Q + K^T R K < 0 and X > 0; for the observer with A_i^T, C^T, L^T.
- An impossibility has Z_i with sum Z_i B = 0 and sum Z_i (M_i + rate I) + transpose >= 0, where all Z_i >= 0 and not
  all are 0, or there is one alone and it is not <= 0: so no P > 0 and Y have M_i P + P M_i^T + B Y + Y^T B^T + 2 rate P
  < 0 for all i. It is about the centres of balls.
"""

import sys
from importlib import import_module
from pathlib import Path
from types import ModuleType

if __name__ == "__main__":
    package = sys.modules["audit"] = ModuleType("audit")  # whatever the folder is called, and wherever it is
    package.__path__ = [str(Path(__file__).parent)]
    main = import_module("audit.certificate").main
    sys.exit(main(sys.argv[1]) if len(sys.argv) == 2 else "usage: python audit certificate.json")
