(* Continuous piecewise affine loops: what matrix inequalities prove of them. Numbers in brackets are of the paper. *)
From Coq Require Import Reals List Lra Psatz ZArith Lia.
Import ListNotations.
Require Import Vectors.
Open Scope R_scope.

Definition mat := nat -> vec.
Definition mul (n : nat) (M : mat) (x : vec) : vec := fun i => dot n (M i) x.

Lemma mul_plus n M x y i : mul n M (plus x y) i = mul n M x i + mul n M y i.
Proof. apply dot_plus. Qed.

Lemma mul_minus n M x y i : mul n M (minus x y) i = mul n M x i - mul n M y i.
Proof. apply dot_minus. Qed.

Lemma mul_ext n M x y i : (forall j, (j < n)%nat -> x j = y j) -> mul n M x i = mul n M y i.
Proof. intros H. apply dot_ext; auto. Qed.

Lemma dot_mul n k M x y : dot n y (mul k M x) = dot k (fun j => sum n (fun i => y i * M i j)) x.
Proof.
  unfold mul, dot.
  rewrite (sum_ext n _ (fun i => sum k (fun j => y i * M i j * x j)))
    by (intros; rewrite <- sum_scale; apply sum_ext; intros; ring).
  rewrite sum_swap. apply sum_ext. intros j _.
  rewrite (Rmult_comm (sum _ _)), <- sum_scale. apply sum_ext. intros. ring.
Qed.

Lemma dot_symmetric n M x y : (forall i j, (i < n)%nat -> (j < n)%nat -> M i j = M j i) ->
  dot n y (mul n M x) = dot n (mul n M y) x.
Proof.
  intros H. rewrite dot_mul. apply dot_ext; auto. intros j Hj. unfold mul, dot. apply sum_ext.
  intros i Hi. rewrite H by auto. ring.
Qed.

Lemma mul_bound n k M : exists c, 0 < c /\ forall x, dot n (mul k M x) (mul k M x) <= c * dot k x x.
Proof.
  exists (1 + sum n (fun i => dot k (M i) (M i))).
  assert (Hs : 0 <= sum n (fun i => dot k (M i) (M i))) by (apply sum_nonneg; intros; apply dot_square_nonneg).
  split; [lra|]. intros x. assert (Hx := dot_square_nonneg k x).
  apply Rle_trans with (sum n (fun i => dot k x x * dot k (M i) (M i))).
  - apply sum_le. intros i _. unfold mul. rewrite (Rmult_comm (dot k x x)). apply dot_bound.
  - rewrite sum_scale. nra.
Qed.

Lemma dot_mul_bound n M : exists c, 0 < c /\ forall x, dot n x (mul n M x) <= c * dot n x x.
Proof.
  destruct (mul_bound n n M) as (c & Hc & H). exists (1 + c). split; [lra|]. intros x.
  assert (H1 := young n 1 x (mul n M x) ltac:(lra)). rewrite Rinv_1 in H1. specialize (H x).
  assert (0 <= dot n x x) by apply dot_square_nonneg.
  assert (0 <= c * dot n x x) by (apply Rmult_le_pos; lra). lra.
Qed.

(* Of finitely many positive numbers there is one below all. *)
Lemma least p (Q : nat -> R -> Prop) : (forall i a a', Q i a -> 0 < a' <= a -> Q i a') ->
  (forall i, (i < p)%nat -> exists a, 0 < a /\ Q i a) -> exists a, 0 < a /\ forall i, (i < p)%nat -> Q i a.
Proof.
  intros Hdown. induction p as [|p IH]; intros H.
  - exists 1. split; [lra|]. intros. lia.
  - destruct IH as (a & Ha & HQ); [intros; apply H; lia|]. destruct (H p) as (c & Hc & HQc); [lia|].
    assert (0 < Rmin a c) by (apply Rmin_pos; auto).
    exists (Rmin a c). split; auto. intros i Hi. destruct (Nat.eq_dec i p) as [->|].
    + apply Hdown with c; auto. split; auto. apply Rmin_r.
    + apply Hdown with a; [apply HQ; lia|]. split; auto. apply Rmin_l.
Qed.

(* The field of a plant *)

Definition halfspace : Type := vec * R.
Definition inside (n : nat) (cell : list halfspace) (x : vec) := Forall (fun h => 0 <= dot n (fst h) x + snd h) cell.

(* f is continuous and affine in each of p closed cells that cover the space, as in (1): on a facet both agree. *)
Record field (n p : nat) (cells : nat -> list halfspace) (A : nat -> mat) (b : nat -> vec) (f : vec ->
  vec) : Prop := {
  covered : forall x, exists i, (i < p)%nat /\ inside n (cells i) x;
  affine : forall x i, (i < p)%nat -> inside n (cells i) x -> forall k, (k < n)%nat -> f x k = mul n (A i) x k + b i k
}.

(* There are such fields: of one cell, to begin with. *)
Lemma field_of_one_cell n A b : field n 1 (fun _ => []) (fun _ => A) (fun _ => b) (fun x => plus (mul n A x) b).
Proof. split; intros; [exists O; split; [lia|constructor]|reflexivity]. Qed.

Definition segment (x y : vec) (s : R) : vec := plus y (scale s (minus x y)).

(* A function that is locally one of lines of slope at most m grows by at most m between 0 and 1. *)
Lemma growth (g : R -> R) (m : R) :
  (forall s, exists d, 0 < d /\ forall t, Rabs (t - s) < d -> exists c, c <= m /\ g t - g s = c * (t - s)) ->
  g 1 - g 0 <= m.
Proof.
  intros H. set (E := fun s => 0 <= s <= 1 /\ g s - g 0 <= m * s).
  destruct (completeness E) as (S & HS).
  { exists 1. intros s (Hs & _). lra. }
  { exists 0. unfold E. lra. }
  destruct HS as (Hup & Hlow).
  assert (H0 : 0 <= S) by (apply Hup; unfold E; lra).
  assert (H1 : S <= 1) by (apply Hlow; intros s (Hs & _); lra).
  destruct (H S) as (d & Hd & Hloc).
  assert (Hin : g S - g 0 <= m * S).
  { destruct (Rle_dec (g S - g 0) (m * S)) as [|Hno]; auto. exfalso.
    assert (S <= S - d); [|lra]. apply Hlow. intros s (Hs & Hg).
    destruct (Rle_dec s (S - d)) as [|Hfar]; auto. exfalso. apply Hno.
    assert (s <= S) by (apply Hup; unfold E; auto).
    destruct (Hloc s) as (c & Hc & He); [apply Rabs_def1; lra|].
    assert (c * (S - s) <= m * (S - s)) by (apply Rmult_le_compat_r; lra). lra. }
  destruct (Rle_lt_or_eq_dec S 1 H1) as [Hlt| ->]; [|lra].
  exfalso. set (h := Rmin d (1 - S) / 2).
  assert (0 < Rmin d (1 - S)) by (apply Rmin_pos; lra).
  assert (Rmin d (1 - S) <= d) by apply Rmin_l. assert (Rmin d (1 - S) <= 1 - S) by apply Rmin_r.
  destruct (Hloc (S + h)) as (c & Hc & He); [unfold h; apply Rabs_def1; lra|].
  assert (c * h <= m * h) by (apply Rmult_le_compat_r; unfold h in *; lra).
  assert (S + h <= S); [|unfold h in *; lra]. apply Hup. unfold E, h in *. split; [lra|].
  replace (S + Rmin d (1 - S) / 2 - S) with (Rmin d (1 - S) / 2) in He by lra. lra.
Qed.

Lemma dot_segment n w x y s : dot n w (segment x y s) = dot n w y + s * dot n w (minus x y).
Proof. unfold segment. rewrite dot_plus, dot_scale. reflexivity. Qed.

(* Close to a point, there is no cell but those that it lies in. *)
Lemma near_cell n x y cell s : exists d, 0 < d /\
  forall t, Rabs (t - s) < d -> inside n cell (segment x y t) -> inside n cell (segment x y s).
Proof.
  induction cell as [|h cell (d & Hd & IH)].
  - exists 1. split; [lra|]. intros. constructor.
  - set (v := dot n (fst h) (segment x y s) + snd h). set (k := Rabs (dot n (fst h) (minus x y))).
    assert (Hk : 0 <= k) by apply Rabs_pos.
    destruct (Rle_dec 0 v) as [Hv|Hv].
    + exists d. split; auto. intros t Ht Hin. inversion Hin; subst. constructor; auto. apply IH with t; auto.
    + exists (- v / (1 + k)). split; [apply Rdiv_lt_0_compat; lra|]. intros t Ht Hin. exfalso.
      inversion Hin as [|? ? Hh _]; subst. rewrite dot_segment in Hh. unfold v in Hv, Ht.
      rewrite dot_segment in Hv, Ht.
      set (c := dot n (fst h) (minus x y)) in *.
      assert (Hc : (t - s) * c <= Rabs (t - s) * k) by (unfold k; rewrite <- Rabs_mult; apply Rle_abs).
      assert (Hl : Rabs (t - s) * (1 + k) < - (dot n (fst h) y + s * c + snd h)).
      { apply (Rmult_lt_compat_r (1 + k)) in Ht; [|lra]. unfold Rdiv in Ht.
      rewrite Rmult_assoc, Rinv_l, Rmult_1_r in Ht; lra. }
      assert (0 <= Rabs (t - s)) by apply Rabs_pos. lra.
Qed.

(* The mean value of a continuous piecewise affine field, as the proof of Theorem 1 uses it. *)
Theorem mean_value n p cells A b f w x y m : field n p cells A b f ->
  (forall i, (i < p)%nat -> dot n w (mul n (A i) (minus x y)) <= m) -> dot n w (minus (f x) (f y)) <= m.
Proof.
  intros (Hcov & Haff) Hm.
  assert (E : dot n w (minus (f x) (f y)) = dot n w (f (segment x y 1)) - dot n w (f (segment x y 0))).
  { assert (H : forall z z', (forall i, (i < n)%nat -> z i = z' i) -> dot n w (f z) = dot n w (f z')).
    { intros z z' Hz. apply dot_ext; auto. intros k Hk. destruct (Hcov z) as (i & Hi & Hin).
      assert (Hin' : inside n (cells i) z').
      { unfold inside in *. eapply Forall_impl; [|exact Hin]. intros h Hh. simpl in *.
        rewrite <- (dot_ext n (fst h) (fst h) z z'); auto. }
      rewrite (Haff z i), (Haff z' i) by auto. f_equal. apply mul_ext. auto. }
    rewrite dot_minus, (H x (segment x y 1)), (H y (segment x y 0)); [reflexivity| |]; intros i _;
      unfold segment, plus, scale, minus; ring. }
  rewrite E. apply (growth (fun s => dot n w (f (segment x y s)))).
  intros s. destruct (least p (fun i d => forall t, Rabs (t - s) < d ->
    inside n (cells i) (segment x y t) -> inside n (cells i) (segment x y s))) as (d & Hd & Hnear).
  - intros i a a' H Ha t Ht. apply H. lra.
  - intros i _. apply near_cell.
  - exists d. split; auto. intros t Ht. destruct (Hcov (segment x y t)) as (i & Hi & Hin).
    exists (dot n w (mul n (A i) (minus x y))). split; [auto|].
    rewrite <- dot_minus. rewrite <- (Rmult_comm (t - s)), <- dot_scale. apply dot_ext; auto. intros k Hk.
    unfold minus at 1. rewrite (Haff _ i Hi Hin), (Haff _ i Hi (Hnear i Hi t Ht Hin)) by auto.
    unfold scale, mul. rewrite !dot_segment. ring.
Qed.

(* Functions of time *)

Definition derivative (n : nat) (x : R -> vec) (t : R) (v : vec) :=
  forall k, (k < n)%nat -> derivable_pt_lim (fun s => x s k) t (v k).

Lemma derivative_sum n (g : nat -> R -> R) t v : (forall k, (k < n)%nat -> derivable_pt_lim (g k) t (v k)) ->
  derivable_pt_lim (fun s => sum n (fun k => g k s)) t (sum n v).
Proof.
  induction n; intros H; simpl; [apply derivable_pt_lim_const|].
  apply (derivable_pt_lim_plus (fun s => sum n (fun k => g k s)) (g n)); auto.
Qed.

Lemma derivative_dot n x y t v w : derivative n x t v -> derivative n y t w ->
  derivable_pt_lim (fun s => dot n (x s) (y s)) t (dot n v (y t) + dot n (x t) w).
Proof.
  intros Hx Hy. unfold dot. rewrite <- sum_plus.
  apply (derivative_sum n (fun k s => x s k * y s k)). intros k Hk.
  apply (derivable_pt_lim_mult (fun s => x s k) (fun s => y s k)); auto.
Qed.

Lemma derivative_mul n k M x t v : derivative k x t v -> derivative n (fun s => mul k M (x s)) t (mul k M v).
Proof.
  intros H i _. unfold mul, dot. apply (derivative_sum k (fun j s => M i j * x s j)). intros j Hj.
  apply (derivable_pt_lim_scal (fun s => x s j)). auto.
Qed.

Lemma derivative_minus n x y t v w : derivative n x t v -> derivative n y t w ->
  derivative n (fun s => minus (x s) (y s)) t (minus v w).
Proof. intros Hx Hy k Hk. apply (derivable_pt_lim_minus (fun s => x s k) (fun s => y s k)); auto. Qed.

Lemma derivative_form n P x t v : (forall i j, (i < n)%nat -> (j < n)%nat -> P i j = P j i) -> derivative n x t v ->
  derivable_pt_lim (fun s => dot n (x s) (mul n P (x s))) t (2 * dot n (mul n P (x t)) v).
Proof.
  intros HP H. replace (2 * dot n (mul n P (x t)) v) with (dot n v (mul n P (x t)) + dot n (x t) (mul n P v)).
  - apply derivative_dot; auto. apply derivative_mul; auto.
  - rewrite (dot_symmetric n P v (x t)), (dot_comm n v) by auto. ring.
Qed.

Definition continuous (n : nat) (x : R -> vec) (t : R) := forall k, (k < n)%nat -> continuity_pt (fun s => x s k) t.

Lemma continuous_sum n (g : nat -> R -> R) t : (forall k, (k < n)%nat -> continuity_pt (g k) t) ->
  continuity_pt (fun s => sum n (fun k => g k s)) t.
Proof.
  induction n; intros H; simpl.
  - apply continuity_pt_const. intros a b. reflexivity.
  - apply (continuity_pt_plus (fun s => sum n (fun k => g k s)) (g n)); auto.
Qed.

Lemma continuous_dot n x y t : continuous n x t -> continuous n y t -> continuity_pt (fun s => dot n (x s) (y s)) t.
Proof.
  intros Hx Hy. apply (continuous_sum n (fun k s => x s k * y s k)). intros k Hk.
  apply (continuity_pt_mult (fun s => x s k) (fun s => y s k)); auto.
Qed.

Lemma continuous_mul n k M x t : continuous k x t -> continuous n (fun s => mul k M (x s)) t.
Proof.
  intros H i _. apply (continuous_sum k (fun j s => M i j * x s j)). intros j Hj.
  apply (continuity_pt_scal (fun s => x s j)). auto.
Qed.

Lemma continuous_minus n x y t : continuous n x t -> continuous n y t -> continuous n (fun s => minus (x s) (y s)) t.
Proof. intros Hx Hy k Hk. apply (continuity_pt_minus (fun s => x s k) (fun s => y s k)); auto. Qed.

(* Inputs may jump, but not at infinitely many times before any T. *)
Definition locally_finite (jumps : R -> Prop) := forall T, exists l, forall t, 0 < t < T -> jumps t -> In t l.

(* A continuous function that does not grow but at finitely many times does not grow. *)
Lemma falling (U U' : R -> R) (l : list R) : forall a b, a <= b ->
  (forall t, a <= t <= b -> continuity_pt U t) ->
  (forall t, a < t < b -> ~ In t l -> derivable_pt_lim U t (U' t) /\ U' t <= 0) -> U b <= U a.
Proof.
  induction l as [|x l IH]; intros a b Hab HC HU.
  - destruct (Rle_lt_or_eq_dec a b Hab) as [Hlt| <-]; [|lra].
    assert (D : forall c, a < c < b -> derivable_pt U c) by (intros c Hc; exists (U' c); apply HU; auto).
    destruct (MVT U id a b D (fun c _ => derivable_pt_id c) Hlt HC) as (c & Hc & He);
      [intros; apply derivable_continuous_pt, derivable_pt_id|].
    destruct (HU c Hc ltac:(auto)) as (Hd & Hs).
    rewrite derive_pt_id, (proj2 (derive_pt_eq U c (U' c) (D c Hc)) Hd) in He. unfold id in He. nra.
  - assert (Hin : forall s, s <> x -> ~ In s l -> ~ In s (x :: l))
      by (intros s Hs Hl [E|Hs2]; [apply Hs; auto|auto]).
    destruct (Rlt_dec a x) as [Ha|Ha]; [destruct (Rlt_dec x b) as [Hb|Hb]|].
    + apply Rle_trans with (U x); apply IH; try lra; intros; try (apply HC; lra);
        (apply HU; [lra|apply Hin; auto; lra]).
    + apply IH; auto. intros. apply HU; auto. apply Hin; auto. lra.
    + apply IH; auto. intros. apply HU; auto. apply Hin; auto. lra.
Qed.

(* What falls at least as fast as it is large, but for jumps of its derivative, falls exponentially. *)
Lemma decay (V V' : R -> R) jumps r : locally_finite jumps -> (forall t, 0 <= t -> continuity_pt V t) ->
  (forall t, 0 < t -> ~ jumps t -> derivable_pt_lim V t (V' t) /\ V' t <= - r * V t) ->
  forall t, 0 <= t -> V t <= exp (- r * t) * V 0.
Proof.
  intros HJ HC HV t Ht. destruct (HJ t) as (l & Hl).
  set (U := fun s => exp (r * s) * V s). set (U' := fun s => r * exp (r * s) * V s + exp (r * s) * V' s).
  assert (HE : forall s, derivable_pt_lim (fun s => exp (r * s)) s (r * exp (r * s))).
  { intros s. replace (r * exp (r * s)) with (exp (r * s) * (r * 1)) by ring.
    apply (derivable_pt_lim_comp (fun s => r * s) exp).
    - apply (derivable_pt_lim_scal id). apply derivable_pt_lim_id.
    - apply derivable_pt_lim_exp. }
  assert (H : U t <= U 0).
  { apply (falling U U' l 0 t Ht).
    - intros s Hs. apply (continuity_pt_mult (fun s => exp (r * s)) V); [|apply HC; lra].
      apply derivable_continuous_pt. exists (r * exp (r * s)). apply HE.
    - intros s Hs Hn. destruct (HV s ltac:(lra)) as (Hd & Hle); [intros Hj; apply Hn, Hl; auto|]. split.
      + apply (derivable_pt_lim_mult (fun s => exp (r * s)) V); auto.
      + unfold U'. assert (0 < exp (r * s)) by apply exp_pos. nra. }
  unfold U in H. rewrite Rmult_0_r, exp_0, Rmult_1_l in H.
  replace (V t) with (exp (- r * t) * (exp (r * t) * V t)).
  - apply Rmult_le_compat_l; [left; apply exp_pos|exact H].
  - rewrite <- Rmult_assoc, <- exp_plus. replace (- r * t + r * t) with 0 by ring. rewrite exp_0. ring.
Qed.

Lemma decay_to (V V' : R -> R) jumps r k : 0 < r -> 0 <= k -> locally_finite jumps ->
  (forall t, 0 <= t -> continuity_pt V t) ->
  (forall t, 0 < t -> ~ jumps t -> derivable_pt_lim V t (V' t) /\ V' t <= - r * V t + k) ->
  forall t, 0 <= t -> V t <= exp (- r * t) * V 0 + k / r.
Proof.
  intros Hr H0 HJ HC HV t Ht.
  assert (H : V t - k / r <= exp (- r * t) * (V 0 - k / r)).
  { apply (decay (fun t => V t - k / r) V' jumps r); auto.
    - intros s Hs. apply (continuity_pt_minus V (fun _ => k / r)); [auto|].
      apply continuity_pt_const. intros a b. reflexivity.
    - intros s Hs Hj. destruct (HV s Hs Hj) as (Hd & Hk). split.
      + rewrite <- (Rminus_0_r (V' s)).
        apply (derivable_pt_lim_minus V (fun _ => k / r)); [auto|apply derivable_pt_lim_const].
      + replace (- r * (V s - k / r)) with (- r * V s + k) by (field; lra). exact Hk. }
  assert (0 <= exp (- r * t) * (k / r)); [|lra].
  apply Rmult_le_pos; [left; apply exp_pos|]. apply Rmult_le_pos; [auto|]. left. apply Rinv_0_lt_compat. auto.
Qed.

(* Matrix inequalities *)

Definition symmetric (n : nat) (P : mat) := forall i j, (i < n)%nat -> (j < n)%nat -> P i j = P j i.

Definition positive_definite (n : nat) (P : mat) :=
  symmetric n P /\ exists m, 0 < m /\ forall x, m * dot n x x <= dot n x (mul n P x).

(* (7) and (17) with a rate: P M + M^T P + 2 r P < 0 *)
Definition falls (n : nat) (P : mat) (r : R) (M : vec -> vec) :=
  exists m, 0 < m /\ forall e, dot n (mul n P e) (M e) + r * dot n e (mul n P e) <= - m * dot n e e.

(* (8) with a rate: M P + P M^T + 2 r P < 0 *)
Definition falls_dual (n : nat) (P : mat) (r : R) (M : vec -> vec) :=
  exists m, 0 < m /\ forall z, dot n z (M (mul n P z)) + r * dot n z (mul n P z) <= - m * dot n z z.

Lemma all_fall n p P r (M : nat -> vec -> vec) : (forall i, (i < p)%nat -> falls n P r (M i)) ->
  exists m, 0 < m /\ forall i, (i < p)%nat -> forall e,
    dot n (mul n P e) (M i e) + r * dot n e (mul n P e) <= - m * dot n e e.
Proof.
  intros H. apply least; [|exact H]. intros i a a' Ha Hle e. specialize (Ha e).
  assert (0 <= dot n e e) by apply dot_square_nonneg. nra.
Qed.

Lemma all_fall_dual n p P r (M : nat -> vec -> vec) : (forall i, (i < p)%nat -> falls_dual n P r (M i)) ->
  exists m, 0 < m /\ forall i, (i < p)%nat -> forall z,
    dot n z (M i (mul n P z)) + r * dot n z (mul n P z) <= - m * dot n z z.
Proof.
  intros H. apply least; [|exact H]. intros i a a' Ha Hle e. specialize (Ha e).
  assert (0 <= dot n e e) by apply dot_square_nonneg. nra.
Qed.

Definition solves (n : nat) (f : R -> vec -> vec) (jumps : R -> Prop) (x : R -> vec) :=
  (forall t, 0 <= t -> continuous n x t) /\ (forall t, 0 < t -> ~ jumps t -> derivative n x t (f t (x t))).

(* Theorem 1, also where the cells and constants depend on time, as those of the generator (15) do: any two solutions
   approach each other. *)
Theorem convergent n p P r (A : nat -> mat) : positive_definite n P ->
  (forall i, (i < p)%nat -> falls n P r (mul n (A i))) ->
  exists c, forall cells b (f : R -> vec -> vec) x y jumps,
    (forall t, field n p (cells t) A (b t) (f t)) -> locally_finite jumps ->
    solves n f jumps x -> solves n f jumps y ->
    forall t, 0 <= t -> dot n (minus (x t) (y t)) (minus (x t) (y t))
      <= c * exp (- (2 * r) * t) * dot n (minus (x 0) (y 0)) (minus (x 0) (y 0)).
Proof.
  intros (HS & l & Hl & HP) HA. destruct (all_fall _ _ _ _ _ HA) as (m & Hm & HM).
  destruct (dot_mul_bound n P) as (u & Hu & HU). exists (/ l * u).
  intros cells b f x y jumps Hf HJ (Cx & Hx) (Cy & Hy) t Ht. set (e := fun s => minus (x s) (y s)).
  assert (Hd : dot n (e t) (mul n P (e t)) <= exp (- (2 * r) * t) * dot n (e 0) (mul n P (e 0))).
  { apply (decay (fun s => dot n (e s) (mul n P (e s)))
      (fun s => 2 * dot n (mul n P (e s)) (minus (f s (x s)) (f s (y s)))) jumps (2 * r)); auto.
    - intros s Hs. assert (continuous n e s) by (apply continuous_minus; auto).
      apply continuous_dot; auto. apply continuous_mul. auto.
    - intros s Hs Hj. split.
      + apply derivative_form; auto. apply derivative_minus; auto.
      + apply Rle_trans with (2 * - (r * dot n (e s) (mul n P (e s)))); [|lra].
        apply Rmult_le_compat_l; [lra|]. apply mean_value with (1 := Hf s). intros i Hi.
        specialize (HM i Hi (e s)). assert (0 <= dot n (e s) (e s)) by apply dot_square_nonneg.
        fold (e s). assert (0 <= m * dot n (e s) (e s)) by (apply Rmult_le_pos; lra). lra. }
  fold (e t) (e 0). specialize (HP (e t)). specialize (HU (e 0)). assert (0 < exp (- (2 * r) * t)) by apply exp_pos.
  apply Rmult_le_reg_l with l; auto.
  replace (l * (/ l * u * exp (- (2 * r) * t) * dot n (e 0) (e 0)))
    with (exp (- (2 * r) * t) * (u * dot n (e 0) (e 0)))
    by (field; lra).
  apply Rle_trans with (1 := HP), Rle_trans with (1 := Hd). apply Rmult_le_compat_l; lra.
Qed.

Lemma dot_head n d w v : dot (n + d) (fun k => if Nat.ltb k n then w k else 0) v = dot n w v.
Proof.
  induction d as [|d IH].
  - rewrite Nat.add_0_r. apply dot_ext; auto. intros k Hk. destruct (Nat.ltb_spec k n); [reflexivity|lia].
  - rewrite Nat.add_succ_r. unfold dot in *. simpl. rewrite IH. destruct (Nat.ltb_spec (n + d) n); [lia|ring].
Qed.

(* Theorem 2: x tracks x_d, and x_hat finds x.
Of the N states the first n are of the plant, and the others of loads that
   act on it and are estimated (none if N = n): x_d has their estimates in their places.
   Nothing is asked of x_d and u_ff
   but (3), in which G is what the estimates' own errors move x_d by:
     with x_d as the generator (15) and (16) makes it,
   whatever that starts from, this is Theorem 3. *)
Section Tracking.

Variables n N m q p : nat.
Variables (cells : nat -> list halfspace) (A : nat -> mat) (b : nat -> vec) (B K C L G : mat).
Variables (P P_inverse Q : mat) (r s : R).

Definition loop (i : nat) (e : vec) : vec := plus (mul n (A i) e) (mul m B (mul n K e)).
Definition observer (i : nat) (e : vec) : vec := plus (mul N (A i) e) (mul q L (mul N C e)).

Hypothesis n_of_N : (n <= N)%nat.
Hypothesis P_definite : positive_definite n P.
Hypothesis P_has_inverse : forall e k, (k < n)%nat -> mul n P (mul n P_inverse e) k = e k.
Hypothesis P_loop : forall i, (i < p)%nat -> falls_dual n P r (loop i).  (* (8) *)
Hypothesis Q_definite : positive_definite N Q.
Hypothesis Q_observer : forall i, (i < p)%nat -> falls N Q s (observer i).  (* (9) *)

Definition input (x_hat x_d u_ff : R -> vec) (t : R) : vec :=
  plus (mul n K (minus (x_hat t) (x_d t))) (u_ff t).  (* (19) *)

(* d acts on the plant, v on the observer, and (3) is missed by o: disturbances, noise, rounding, what is left of a
   reference that is played back. They, and u_ff, may jump. *)
Record closed_loop (f : vec -> vec) (x x_hat x_d u_ff d v o : R -> vec) (jumps : R -> Prop) : Prop := {
  few_jumps : locally_finite jumps;
  no_jumps_of_states : forall t, 0 <= t -> continuous N x t /\ continuous N x_hat t /\ continuous n x_d t;
  plant_runs : forall t, 0 < t -> ~ jumps t -> derivative N x t
    (plus (plus (f (x t)) (mul m B (input x_hat x_d u_ff t))) (d t));  (* (1) *)
  observer_runs : forall t, 0 < t -> ~ jumps t -> derivative N x_hat t
    (plus (plus (plus (f (x_hat t)) (mul m B (input x_hat x_d u_ff t)))
      (mul q L (minus (mul N C (x_hat t)) (mul N C (x t))))) (v t));  (* (18) *)
  desired_runs : forall t, 0 < t -> ~ jumps t -> derivative n x_d t
    (plus (plus (plus (f (x_d t)) (mul m B (u_ff t))) (mul N G (minus (x_hat t) (x t)))) (o t));  (* (3) *)
  loads_as_estimated : forall t k, 0 <= t -> (n <= k < N)%nat -> x_d t k = x_hat t k
}.

Definition errors (x x_hat x_d : R -> vec) (t : R) : R :=
  dot n (minus (x t) (x_d t)) (minus (x t) (x_d t)) + dot N (minus (x_hat t) (x t)) (minus (x_hat t) (x t)).

Definition observer_velocity (f : vec -> vec) (x x_hat d v : R -> vec) (t : R) : vec :=
  plus (plus (minus (f (x_hat t)) (f (x t))) (mul q L (mul N C (minus (x_hat t) (x t))))) (minus (v t) (d t)).

Lemma observer_error f x x_hat x_d u_ff d v o jumps t w M :
  field N p cells A b f -> closed_loop f x x_hat x_d u_ff d v o jumps -> 0 < t -> ~ jumps t ->
  (forall i, (i < p)%nat -> dot N w (observer i (minus (x_hat t) (x t))) <= M) ->
  derivative N (fun t => minus (x_hat t) (x t)) t (observer_velocity f x x_hat d v t)
  /\ dot N w (observer_velocity f x x_hat d v t) <= M + dot N w (minus (v t) (d t)).
Proof.
  intros Hf Hc Ht Hj H. unfold observer_velocity. split.
  - intros k Hk. assert (H1 := observer_runs _ _ _ _ _ _ _ _ _ Hc t Ht Hj k Hk).
    assert (H2 := plant_runs _ _ _ _ _ _ _ _ _ Hc t Ht Hj k Hk).
    assert (H3 := derivable_pt_lim_minus _ _ _ _ _ H1 H2).
    replace (plus (plus (minus (f (x_hat t)) (f (x t))) (mul q L (mul N C (minus (x_hat t) (x t)))))
      (minus (v t) (d t)) k) with
      (plus (plus (plus (f (x_hat t)) (mul m B (input x_hat x_d u_ff t)))
        (mul q L (minus (mul N C (x_hat t)) (mul N C (x t))))) (v t) k
       - plus (plus (f (x t)) (mul m B (input x_hat x_d u_ff t))) (d t) k); [exact H3|].
    unfold plus. rewrite (mul_ext q L (mul N C (minus (x_hat t) (x t))) (minus (mul N C (x_hat t)) (mul N C (x t)))).
    + unfold minus. ring.
    + intros j _. unfold minus at 2. apply mul_minus.
  - rewrite dot_plus. apply Rplus_le_compat_r. rewrite dot_plus. set (g := dot N w (mul q L _)).
    assert (dot N w (minus (f (x_hat t)) (f (x t))) <= M - g); [|lra].
    apply mean_value with (1 := Hf). intros i Hi. specialize (H i Hi). unfold observer in H. rewrite dot_plus in H.
    fold g in H. lra.
Qed.

(* What the error of the observer does to the loop *)
Definition loads_only (o : vec) : vec := fun k => if Nat.ltb k n then 0 else o k.

Definition tracking_velocity (f : vec -> vec) (x x_hat x_d d o : R -> vec) (t : R) : vec :=
  let delta := minus (x_hat t) (x t) in
  plus (plus (plus (minus (f (x t)) (f (x_d t))) (mul m B (mul n K (minus (x t) (x_d t)))))
    (minus (mul m B (mul n K delta)) (mul N G delta))) (minus (d t) (o t)).

Lemma dot_first_n w v : dot N (fun k => if Nat.ltb k n then w k else 0) v = dot n w v.
Proof. replace N with (n + (N - n))%nat by lia. apply dot_head. Qed.

Lemma dot_split a v : dot N a v = dot n a v + dot N a (loads_only v).
Proof.
  rewrite (dot_comm n), <- dot_first_n, dot_comm. rewrite (dot_comm N _ a). unfold dot. rewrite <- sum_plus.
  apply sum_ext. intros k _. unfold loads_only. destruct (Nat.ltb k n); ring.
Qed.

Lemma tracking_error f x x_hat x_d u_ff d v o jumps t w M :
  field N p cells A b f -> closed_loop f x x_hat x_d u_ff d v o jumps -> 0 < t -> ~ jumps t ->
  (forall i, (i < p)%nat -> dot n w (loop i (minus (x t) (x_d t)))
    - dot n w (mul N (A i) (loads_only (minus (x_hat t) (x t)))) <= M) ->
  derivative n (fun t => minus (x t) (x_d t)) t (tracking_velocity f x x_hat x_d d o t)
  /\ dot n w (tracking_velocity f x x_hat x_d d o t) <= M
    + dot n w (minus (mul m B (mul n K (minus (x_hat t) (x t)))) (mul N G (minus (x_hat t) (x t))))
    + dot n w (minus (d t) (o t)).
Proof.
  intros Hf Hc Ht Hj H. unfold tracking_velocity.
  set (delta := minus (x_hat t) (x t)) in *. set (g := mul m B (mul n K (minus (x t) (x_d t)))). split.
  - intros k Hk. assert (HkN : (k < N)%nat) by lia.
    assert (H1 := plant_runs _ _ _ _ _ _ _ _ _ Hc t Ht Hj k HkN).
    assert (H2 := desired_runs _ _ _ _ _ _ _ _ _ Hc t Ht Hj k Hk).
    assert (H3 := derivable_pt_lim_minus _ _ _ _ _ H1 H2). fold delta in H3.
    replace (plus (plus (plus (minus (f (x t)) (f (x_d t))) g) (minus (mul m B (mul n K delta)) (mul N G delta)))
      (minus (d t) (o t)) k) with
      (plus (plus (f (x t)) (mul m B (input x_hat x_d u_ff t))) (d t) k
       - plus (plus (plus (f (x_d t)) (mul m B (u_ff t))) (mul N G delta)) (o t) k); [exact H3|].
    unfold plus. unfold minus at 1 2 3.
    replace (mul m B (input x_hat x_d u_ff t) k) with (mul m B (u_ff t) k + g k + mul m B (mul n K delta) k);
      [unfold minus; ring|].
    unfold g, delta. rewrite <- !mul_plus. apply mul_ext. intros j _. unfold input, plus. rewrite !mul_minus. ring.
  - rewrite dot_plus. apply Rplus_le_compat_r. rewrite dot_plus. apply Rplus_le_compat_r. rewrite dot_plus.
    assert (dot n w (minus (f (x t)) (f (x_d t))) <= M - dot n w g); [|lra].
    rewrite <- dot_first_n. apply mean_value with (1 := Hf). intros i Hi. specialize (H i Hi). unfold loop in H.
    rewrite dot_plus in H. fold g in H. rewrite dot_first_n.
    rewrite (dot_ext n w w (mul N (A i) (minus (x t) (x_d t)))
      (minus (mul n (A i) (minus (x t) (x_d t))) (mul N (A i) (loads_only delta)))).
    + rewrite dot_minus. lra.
    + auto.
    + intros k Hk.
      change (dot N (A i k) (minus (x t) (x_d t)) =
        dot n (A i k) (minus (x t) (x_d t)) - dot N (A i k) (loads_only delta)).
      rewrite dot_split.
      rewrite (dot_ext N (A i k) (A i k) (loads_only (minus (x t) (x_d t))) (scale (-1) (loads_only delta))).
      * rewrite dot_scale. ring.
      * auto.
      * intros j Hn. unfold loads_only, scale, delta, minus. destruct (Nat.ltb_spec j n); [ring|].
        rewrite (loads_as_estimated _ _ _ _ _ _ _ _ _ Hc t j (Rlt_le _ _ Ht)) by lia. ring.
Qed.

Lemma difference_small k x y : dot k (minus x y) (minus x y) <= 2 * (dot k x x + dot k y y).
Proof.
  unfold dot. rewrite <- sum_plus, <- sum_scale. apply sum_le. intros i _. unfold minus.
  assert (0 <= (x i + y i) * (x i + y i)) by apply Rle_0_sqr. lra.
Qed.

Lemma loads_only_small v : dot N (loads_only v) (loads_only v) <= dot N v v.
Proof. apply sum_le. intros k _. unfold loads_only. assert (0 <= v k * v k) by apply Rle_0_sqr.
destruct (Nat.ltb k n); lra. Qed.

Lemma first_n_small v : dot n v v <= dot N v v.
Proof.
  rewrite <- dot_first_n. apply sum_le. intros k _. assert (0 <= v k * v k) by apply Rle_0_sqr.
  destruct (Nat.ltb k n); lra.
Qed.

(* |A_i v|^2 <= c |v|^2 for one c *)
Lemma slopes_bound : exists c, 0 < c /\ forall i, (i < p)%nat -> forall v,
  dot n (mul N (A i) v) (mul N (A i) v) <= c * dot N v v.
Proof.
  destruct (least p (fun i a => forall v, a * dot n (mul N (A i) v) (mul N (A i) v) <= dot N v v)) as (a & Ha & H).
  - intros i a a' H Hle v. specialize (H v).
    assert (0 <= dot n (mul N (A i) v) (mul N (A i) v)) by apply dot_square_nonneg. nra.
  - intros i _. destruct (mul_bound n N (A i)) as (c & Hc & H). exists (/ c). split; [apply Rinv_0_lt_compat; auto|].
    intros v. specialize (H v). apply Rmult_le_reg_l with c; auto. rewrite <- Rmult_assoc, Rinv_r; lra.
  - exists (/ a). split; [apply Rinv_0_lt_compat; auto|]. intros i Hi v. specialize (H i Hi v).
    apply Rmult_le_reg_l with a; auto. rewrite <- Rmult_assoc, Rinv_r; lra.
Qed.

(* Exponentially without d and v; with them, input-to-state stable, as Theorem 2 has it. *)
Theorem tracking : 0 < r -> 0 < s -> exists c g, forall f x x_hat x_d u_ff d v off jumps W,
  field N p cells A b f -> closed_loop f x x_hat x_d u_ff d v off jumps ->
  (forall t, 0 <= t -> dot N (d t) (d t) + dot N (v t) (v t) + dot n (off t) (off t) <= W) ->
  forall t, 0 <= t -> errors x x_hat x_d t <= c * exp (- (2 * Rmin r s) * t) * errors x x_hat x_d 0 + g * W.
Proof.
  intros Hr0 Hs0. destruct P_definite as (PS & l & Hl & HP). destruct Q_definite as (QS & k & Hk & HQ).
  destruct (all_fall_dual _ _ _ _ _ P_loop) as (mu & Hmu & HM).
  destruct (all_fall _ _ _ _ _ Q_observer) as (nu & Hnu & HN).
  (* what the observer's error adds, and forms from above *)
  destruct (mul_bound n m B) as (g1 & Hg1 & HG1). destruct (mul_bound m n K) as (g2 & Hg2 & HG2).
  destruct (mul_bound n N G) as (g3 & Hg3 & HG3). destruct slopes_bound as (g4 & Hg4 & HG4).
  destruct (mul_bound n n P) as (h & Hh & HH). destruct (mul_bound n n P_inverse) as (h' & Hh' & HH').
  destruct (mul_bound N N Q) as (q' & Hq' & HQ').
  destruct (dot_mul_bound n P) as (u & Hu & HU). destruct (dot_mul_bound N Q) as (y & Hy & HY).
  set (g := g1 * g2 + g3 + g4). assert (Hg12 : 0 < g1 * g2) by (apply Rmult_lt_0_compat; auto).
  assert (Hg : 0 < g) by (unfold g; lra).
  assert (Hmui : 0 < / mu) by (apply Rinv_0_lt_compat; auto).
  assert (Hnui : 0 < / nu) by (apply Rinv_0_lt_compat; auto).
  set (w := 2 * g * / mu * / nu).
  assert (Hw : 0 < w) by (unfold w; repeat apply Rmult_lt_0_compat; lra).
  set (low := Rmin (l / h) (w * k)).
  assert (Hlow : 0 < low) by (apply Rmin_pos; [apply Rdiv_lt_0_compat; auto|apply Rmult_lt_0_compat; auto]).
  set (high := u * h' + w * y). set (R0 := Rmin r s). assert (HR0 : 0 < R0) by (apply Rmin_pos; auto).
  set (kappa := 4 * / mu + 2 * (w * (q' * / nu))).
  assert (Hkappa : 0 < kappa).
  { assert (0 < w * (q' * / nu)) by (repeat apply Rmult_lt_0_compat; lra). unfold kappa. lra. }
  exists (high / low), (kappa / (2 * R0) / low). intros f x x_hat x_d u_ff d v off jumps W Hf Hc HW t Ht.
  set (e := fun t => minus (x t) (x_d t)). set (o := fun t => minus (x_hat t) (x t)).
  set (z := fun t => mul n P_inverse (e t)).
  set (V := fun t => dot n (z t) (mul n P (z t)) + w * dot N (o t) (mul N Q (o t))).
  assert (Ez : forall t i, (i < n)%nat -> mul n P (z t) i = e t i) by (intros; apply P_has_inverse; auto).
  set (V' := fun t => 2 * dot n (mul n P (z t)) (mul n P_inverse (tracking_velocity f x x_hat x_d d off t))
    + w * (2 * dot N (mul N Q (o t)) (observer_velocity f x x_hat d v t))).
  assert (Hfall : forall t, 0 < t -> ~ jumps t -> derivable_pt_lim V t (V' t) /\ V' t <= - (2 * R0) * V t + kappa * W).
  { intros a Ha Hj.
    (* z.y <= mu/4 |z|^2 + |y|^2 / mu *)
    assert (Hyoung : forall y, dot n (z a) y <= mu / 4 * dot n (z a) (z a) + / mu * dot n y y).
    { intros y'. assert (H := young n (mu / 2) (z a) y' ltac:(lra)).
      replace (/ (mu / 2)) with (2 * / mu) in H by (field; lra). lra. }
    destruct (observer_error f x x_hat x_d u_ff d v off jumps a (mul N Q (o a))
      (- nu * dot N (o a) (o a) - s * dot N (o a) (mul N Q (o a))) Hf Hc Ha Hj) as (Ho & Ho').
    { intros i Hi. specialize (HN i Hi (o a)). fold (o a). lra. }
    destruct (tracking_error f x x_hat x_d u_ff d v off jumps a (z a)
      (- (3 * mu / 4) * dot n (z a) (z a) - r * dot n (z a) (mul n P (z a)) + / mu * (g4 * dot N (o a) (o a)))
      Hf Hc Ha Hj) as (He & He').
    { intros i Hi. specialize (HM i Hi (z a)). fold (e a) (o a).
      rewrite (dot_ext n (z a) (z a) (loop i (e a)) (loop i (mul n P (z a)))).
      - assert (H := Hyoung (scale (-1) (mul N (A i) (loads_only (o a))))).
        rewrite !dot_scale, (dot_comm n (scale _ _)), dot_scale in H.
        assert (H4 := HG4 i Hi (loads_only (o a))). assert (H5 := loads_only_small (o a)).
        assert (/ mu * dot n (mul N (A i) (loads_only (o a))) (mul N (A i) (loads_only (o a)))
          <= / mu * (g4 * dot N (o a) (o a))); [|lra].
        apply Rmult_le_compat_l; [lra|]. apply Rle_trans with (1 := H4). apply Rmult_le_compat_l; lra.
      - auto.
      - intros j _. unfold loop, plus.
        rewrite (mul_ext n (A i) (mul n P (z a)) (e a)) by auto.
        rewrite (mul_ext m B (mul n K (mul n P (z a))) (mul n K (e a))); [reflexivity|]. intros. apply mul_ext. auto. }
    set (o' := observer_velocity f x x_hat d v a) in *. set (e' := tracking_velocity f x x_hat x_d d off a) in *.
    fold (o a) in He'. rewrite (dot_minus n (z a) (mul m B _)) in He'.
    assert (Hz' : derivative n z a (mul n P_inverse e')) by (apply derivative_mul; exact He).
    unfold V'. fold o' e'. split.
    - apply (derivable_pt_lim_plus (fun t => dot n (z t) (mul n P (z t))) (fun t => w * dot N (o t) (mul N Q (o t)))).
      + apply derivative_form; auto.
      + apply (derivable_pt_lim_scal (fun t => dot N (o t) (mul N Q (o t)))). apply derivative_form; auto.
    - rewrite <- (dot_symmetric n P (mul n P_inverse e') (z a)) by auto.
      rewrite (dot_ext n (z a) (z a) (mul n P (mul n P_inverse e')) e') by auto.
      assert (Hy1 := Hyoung (mul m B (mul n K (o a)))).
      assert (Hy2 := Hyoung (scale (-1) (mul N G (o a)))).
      rewrite !dot_scale, (dot_comm n (scale _ _)), dot_scale in Hy2.
      assert (Hy3 := Hyoung (minus (d a) (off a))). specialize (HW a (Rlt_le _ _ Ha)).
      assert (Hdn := first_n_small (d a)). assert (Hoff := dot_square_nonneg n (off a)). assert (Hvv := dot_square_nonneg N (v a)).
      assert (Hdd := dot_square_nonneg N (d a)).
      (* what d and v do to the observer *)
      set (c := minus (v a) (d a)) in *.
      assert (Hdo : dot n (minus (d a) (off a)) (minus (d a) (off a)) <= 2 * W).
      { assert (H := difference_small n (d a) (off a)). lra. }
      assert (Hcc : dot N c c <= 2 * W).
      { assert (H := difference_small N (v a) (d a)). unfold c. lra. }
      assert (Hco : dot N (mul N Q (o a)) c <= nu / 2 * dot N (o a) (o a) + q' * / nu * W).
      { assert (H := young N (nu / q') (mul N Q (o a)) c ltac:(apply Rdiv_lt_0_compat; auto)).
        replace (/ (nu / q')) with (q' * / nu) in H by (field; lra).
        assert (H1 : nu / q' * dot N (mul N Q (o a)) (mul N Q (o a)) <= nu / q' * (q' * dot N (o a) (o a))).
        { apply Rmult_le_compat_l; [left; apply Rdiv_lt_0_compat; auto|apply HQ']. }
        replace (nu / q' * (q' * dot N (o a) (o a))) with (nu * dot N (o a) (o a)) in H1 by (field; lra).
        assert (H2 : q' * / nu * dot N c c <= q' * / nu * (2 * W)).
        { apply Rmult_le_compat_l; [|exact Hcc]. left. apply Rmult_lt_0_compat; auto. }
        lra. }
      set (Vz := dot n (z a) (mul n P (z a))) in *. set (Vo := dot N (o a) (mul N Q (o a))) in *.
      set (zz := dot n (z a) (z a)) in *. set (oo := dot N (o a) (o a)) in *.
      assert (Hzz : 0 <= zz) by apply dot_square_nonneg. assert (Hoo : 0 <= oo) by apply dot_square_nonneg.
      assert (H1 : / mu * dot n (mul m B (mul n K (o a))) (mul m B (mul n K (o a))) <= / mu * (g1 * g2 * oo)).
      { apply Rmult_le_compat_l; [lra|]. apply Rle_trans with (1 := HG1 _). rewrite Rmult_assoc.
        apply Rmult_le_compat_l; [lra|]. apply Rle_trans with (1 := HG2 _).
        apply Rmult_le_compat_l; [lra|apply first_n_small]. }
      assert (H2 : / mu * dot n (mul N G (o a)) (mul N G (o a)) <= / mu * (g3 * oo))
        by (apply Rmult_le_compat_l; [lra|apply HG3]).
      assert (H6 : / mu * dot n (minus (d a) (off a)) (minus (d a) (off a)) <= / mu * (2 * W)) by (apply Rmult_le_compat_l; lra).
      assert (Ew : w * (nu / 2 * oo) = / mu * (g1 * g2 * oo) + / mu * (g3 * oo) + / mu * (g4 * oo))
        by (unfold w, g; field; lra).
      assert (HVz : 0 <= Vz) by (apply Rle_trans with (2 := HP (z a)); apply Rmult_le_pos; fold zz; lra).
      assert (HVo : 0 <= Vo) by (apply Rle_trans with (2 := HQ (o a)); apply Rmult_le_pos; fold oo; lra).
      assert (Hr : R0 <= r) by apply Rmin_l. assert (Hs : R0 <= s) by apply Rmin_r.
      assert (Hw1 : w * dot N (mul N Q (o a)) o' <= w * (- nu * oo - s * Vo + (nu / 2 * oo + q' * / nu * W)))
        by (apply Rmult_le_compat_l; lra).
      assert (H3 : R0 * Vz <= r * Vz) by (apply Rmult_le_compat_r; lra).
      assert (H4 : w * (R0 * Vo) <= w * (s * Vo)) by (apply Rmult_le_compat_l; [lra|apply Rmult_le_compat_r; lra]).
      unfold V, kappa. fold Vz Vo.
      replace (w * (2 * dot N (mul N Q (o a)) o')) with (2 * (w * dot N (mul N Q (o a)) o')) by ring.
      replace (w * (- nu * oo - s * Vo + (nu / 2 * oo + q' * / nu * W)))
        with (- (w * (nu / 2 * oo)) - w * (s * Vo) + w * (q' * / nu) * W) in Hw1 by (field; lra).
      replace (- (2 * R0) * (Vz + w * Vo)) with (- 2 * (R0 * Vz) - 2 * (w * (R0 * Vo))) by ring.
      replace ((4 * / mu + 2 * (w * (q' * / nu))) * W) with (2 * (/ mu * (2 * W)) + 2 * (w * (q' * / nu) * W)) by ring.
      lra. }
  assert (HW0 : 0 <= W).
  { specialize (HW 0 (Rle_refl 0)). assert (0 <= dot N (d 0) (d 0)) by apply dot_square_nonneg.
    assert (0 <= dot N (v 0) (v 0)) by apply dot_square_nonneg.
    assert (0 <= dot n (off 0) (off 0)) by apply dot_square_nonneg. lra. }
  assert (HVt : V t <= exp (- (2 * R0) * t) * V 0 + kappa * W / (2 * R0)).
  { apply (decay_to V V' jumps); auto; [lra|apply Rmult_le_pos; lra|apply (few_jumps _ _ _ _ _ _ _ _ _ Hc)|].
    intros a Ha. destruct (no_jumps_of_states _ _ _ _ _ _ _ _ _ Hc a Ha) as (Cx & Cxh & Cd).
    assert (Ce : continuous n z a).
    { apply continuous_mul, continuous_minus; [intros k' Hk'; apply Cx; lia|exact Cd]. }
    assert (Co : continuous N o a) by (apply continuous_minus; auto).
    apply (continuity_pt_plus (fun t => dot n (z t) (mul n P (z t))) (fun t => w * dot N (o t) (mul N Q (o t)))).
    - apply continuous_dot; [|apply continuous_mul]; auto.
    - apply (continuity_pt_scal (fun t => dot N (o t) (mul N Q (o t)))). apply continuous_dot; [|apply continuous_mul]; auto. }
  assert (Hbelow : low * errors x x_hat x_d t <= V t).
  { unfold errors, V. fold (e t) (o t).
    assert (He : dot n (e t) (e t) <= h * dot n (z t) (z t)).
    { rewrite <- (dot_ext n (mul n P (z t)) (e t) (mul n P (z t)) (e t)) by auto. apply HH. }
    assert (H1 : l / h * dot n (e t) (e t) <= dot n (z t) (mul n P (z t))).
    { apply Rle_trans with (2 := HP (z t)).
    replace (l * dot n (z t) (z t)) with (l / h * (h * dot n (z t) (z t))) by (field; lra).
      apply Rmult_le_compat_l; [left; apply Rdiv_lt_0_compat; auto|exact He]. }
    assert (H2 : w * k * dot N (o t) (o t) <= w * dot N (o t) (mul N Q (o t))).
    { rewrite Rmult_assoc. apply Rmult_le_compat_l; [lra|apply HQ]. }
    assert (L1 : low <= l / h) by apply Rmin_l. assert (L2 : low <= w * k) by apply Rmin_r.
    assert (low * dot n (e t) (e t) <= l / h * dot n (e t) (e t))
      by (apply Rmult_le_compat_r; [apply dot_square_nonneg|auto]).
    assert (low * dot N (o t) (o t) <= w * k * dot N (o t) (o t))
      by (apply Rmult_le_compat_r; [apply dot_square_nonneg|auto]).
    lra. }
  assert (Habove : V 0 <= high * errors x x_hat x_d 0).
  { unfold errors, V, high. fold (e 0) (o 0).
    assert (H1 : dot n (z 0) (mul n P (z 0)) <= u * (h' * dot n (e 0) (e 0))).
    { apply Rle_trans with (1 := HU _). apply Rmult_le_compat_l; [lra|apply HH']. }
    assert (H2 : w * dot N (o 0) (mul N Q (o 0)) <= w * (y * dot N (o 0) (o 0)))
      by (apply Rmult_le_compat_l; [lra|apply HY]).
    assert (0 <= dot n (e 0) (e 0)) by apply dot_square_nonneg.
    assert (0 <= dot N (o 0) (o 0)) by apply dot_square_nonneg.
    assert (0 <= u * h') by nra. assert (0 <= w * y) by nra. nra. }
  assert (Hexp : 0 < exp (- (2 * R0) * t)) by apply exp_pos.
  apply Rmult_le_reg_l with low; auto.
  replace (low * (high / low * exp (- (2 * R0) * t) * errors x x_hat x_d 0 + kappa / (2 * R0) / low * W))
    with (exp (- (2 * R0) * t) * (high * errors x x_hat x_d 0) + kappa * W / (2 * R0)) by (field; lra).
  apply Rle_trans with (1 := Hbelow), Rle_trans with (1 := HVt). apply Rplus_le_compat_r.
  apply Rmult_le_compat_l; lra.
Qed.

End Tracking.
