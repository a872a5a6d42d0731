(* For the f that is A_i x + b_i in each cell@merged@, and from
   every start: x - x_d and x_hat - x go to 0, at least as fast as e^(-min(alpha, beta) t / D);
   where plant and observer are disturbed, or x_d is off (3), as close to 0 as that is small. *)
Theorem @name@_tracks : exists c g, forall f x x_hat x_d u_ff disturbance noise off jumps most,
  field @N@ (length A) (polyhedra D cells) (slopes D A) (offsets D b) f ->
  closed_loop @n@ @N@ (length K) (length C) (over D B) (over D K) (over D C) (over D L) (over D G)
    f x x_hat x_d u_ff disturbance noise off jumps ->
  (forall t, 0 <= t ->
    dot @N@ (disturbance t) (disturbance t) + dot @N@ (noise t) (noise t)
      + dot @n@ (off t) (off t) <= most) ->
  forall t, 0 <= t ->
    errors @n@ @N@ x x_hat x_d t
      <= c * exp (- (2 * Rmin (ratio alpha D) (ratio beta D)) * t)
        * errors @n@ @N@ x x_hat x_d 0 + g * most.
Proof.
  exact (tracks @n@ @N@ D A b cells B K C L G alpha P W d beta Q eq_refl controller observer).
Qed.
