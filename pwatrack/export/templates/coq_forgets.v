
(* Any two solutions of the generator for one reference and the same loads approach each other. *)
Theorem @name@_generator : exists c, forall cells b (f : R -> vec -> vec) x y jumps,
  (forall t, field @r@ (length A_eta) (cells t) (slopes D A_eta) (b t) (f t)) ->
  locally_finite jumps -> solves @r@ f jumps x -> solves @r@ f jumps y ->
  forall t, 0 <= t -> dot @r@ (minus (x t) (y t)) (minus (x t) (y t))
    <= c * exp (- (2 * ratio gamma D) * t) * dot @r@ (minus (x 0) (y 0)) (minus (x 0) (y 0)).
Proof. exact (generator_converges @r@ D A_eta gamma P_eta generator). Qed.
