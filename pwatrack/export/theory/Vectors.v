(* Vectors are functions of an index, matrices are lists of rows of whole numbers; n is how many entries count. *)
From Coq Require Import Reals List Lra Psatz ZArith Lia.
From Bignums Require Import BigZ.
Import ListNotations.
Open Scope R_scope.

(* Sums and inner products *)

Fixpoint sum (n : nat) (f : nat -> R) : R := match n with O => 0 | S k => sum k f + f k end.

Definition vec := nat -> R.
Definition dot (n : nat) (x y : vec) : R := sum n (fun i => x i * y i).

Lemma sum_ext n f g : (forall i, (i < n)%nat -> f i = g i) -> sum n f = sum n g.
Proof. induction n; simpl; intros H; auto. rewrite IHn, H; auto. Qed.

Lemma sum_plus n f g : sum n (fun i => f i + g i) = sum n f + sum n g.
Proof. induction n; simpl; [|rewrite IHn]; lra. Qed.

Lemma sum_scale n c f : sum n (fun i => c * f i) = c * sum n f.
Proof. induction n; simpl; [|rewrite IHn]; lra. Qed.

Lemma sum_zero n : sum n (fun _ => 0) = 0.
Proof. induction n; simpl; [|rewrite IHn]; lra. Qed.

Lemma sum_swap n m f : sum n (fun i => sum m (f i)) = sum m (fun j => sum n (fun i => f i j)).
Proof.
  induction n; simpl; [symmetry; apply sum_zero|].
  rewrite IHn, <- sum_plus. reflexivity.
Qed.

Lemma sum_first n f : sum (S n) f = f O + sum n (fun i => f (S i)).
Proof. induction n; simpl in *; [lra|]. rewrite IHn. lra. Qed.

Lemma sum_le n f g : (forall i, (i < n)%nat -> f i <= g i) -> sum n f <= sum n g.
Proof. induction n; simpl; intros H; [lra|]. assert (sum n f <= sum n g) by auto. specialize (H n).
lra || (assert (f n <= g n) by auto; lra). Qed.

Lemma sum_nonneg n f : (forall i, (i < n)%nat -> 0 <= f i) -> 0 <= sum n f.
Proof. intros H. rewrite <- (sum_zero n). apply sum_le. auto. Qed.

Lemma sum_term n f i : (i < n)%nat -> (forall j, (j < n)%nat -> 0 <= f j) -> f i <= sum n f.
Proof.
  induction n; simpl; [lia|]. intros Hi H.
  assert (0 <= sum n f) by (apply sum_nonneg; auto).
  destruct (Nat.eq_dec i n) as [->|]; [lra|].
  assert (f i <= sum n f) by (apply IHn; auto; lia). assert (0 <= f n) by auto. lra.
Qed.

Lemma sum_delta n f i : (i < n)%nat -> sum n (fun j => (if Nat.eqb i j then 1 else 0) * f j) = f i.
Proof.
  induction n; simpl; [lia|]. intros H.
  destruct (Nat.eqb_spec i n) as [->|].
  - rewrite (sum_ext _ _ (fun _ => 0)), sum_zero; [lra|].
    intros j Hj. destruct (Nat.eqb_spec n j); [lia|lra].
  - rewrite IHn by lia. lra.
Qed.

Lemma dot_comm n x y : dot n x y = dot n y x.
Proof. apply sum_ext. intros. lra. Qed.

Lemma dot_first n x y : dot (S n) x y = x O * y O + dot n (fun i => x (S i)) (fun i => y (S i)).
Proof. apply sum_first. Qed.

Lemma dot_ext n x x' y y' :
  (forall i, (i < n)%nat -> x i = x' i) -> (forall i, (i < n)%nat -> y i = y' i) -> dot n x y = dot n x' y'.
Proof. intros Hx Hy. apply sum_ext. intros i Hi. rewrite Hx, Hy; auto. Qed.

Definition plus (x y : vec) : vec := fun i => x i + y i.
Definition minus (x y : vec) : vec := fun i => x i - y i.
Definition scale (c : R) (x : vec) : vec := fun i => c * x i.

Lemma dot_plus n x y z : dot n x (plus y z) = dot n x y + dot n x z.
Proof. unfold dot, plus. rewrite <- sum_plus. apply sum_ext. intros. lra. Qed.

Lemma dot_minus n x y z : dot n x (minus y z) = dot n x y - dot n x z.
Proof. unfold dot, minus. induction n; simpl; [|rewrite IHn]; lra. Qed.

Lemma dot_scale n c x y : dot n x (scale c y) = c * dot n x y.
Proof. unfold dot, scale. rewrite <- sum_scale. apply sum_ext. intros. lra. Qed.

Lemma dot_square_nonneg n x : 0 <= dot n x x.
Proof. apply sum_nonneg. intros. nra. Qed.

Lemma entry_square n x i : (i < n)%nat -> x i * x i <= dot n x x.
Proof. intros H. apply (sum_term n (fun i => x i * x i)); auto. intros. nra. Qed.

(* 2 x.y <= c |x|^2 + |y|^2 / c *)
Lemma young n c x y : 0 < c -> 2 * dot n x y <= c * dot n x x + / c * dot n y y.
Proof.
  intros Hc. unfold dot. rewrite <- !sum_scale, <- sum_plus. apply sum_le. intros i _.
  assert (H : 0 <= / c * ((c * x i - y i) * (c * x i - y i))).
  { apply Rmult_le_pos; [left; apply Rinv_0_lt_compat; auto|apply Rle_0_sqr]. }
  replace (/ c * _) with (c * (x i * x i) - 2 * (x i * y i) + / c * (y i * y i)) in H by (field; lra). lra.
Qed.

(* Matrices *)

Definition row := list BigZ.t.
Definition matrix := list row.
Definition value (r : row) : vec := fun j => IZR (BigZ.to_Z (nth j r 0%bigZ)).
Definition rows (M : matrix) (i : nat) : row := nth i M [].
Definition entry (M : matrix) (i j : nat) : R := value (rows M i) j.
Definition times (n : nat) (M : matrix) (x : vec) : vec := fun i => dot n (value (rows M i)) x.
Definition transposed_times (n : nat) (M : matrix) (x : vec) : vec := fun j => sum n (fun i => x i * entry M i j).

Lemma times_dot n M x y : dot n y (times n M x) = dot n (transposed_times n M y) x.
Proof.
  unfold dot, times, transposed_times, entry, dot.
  rewrite (sum_ext n _ (fun i => sum n (fun j => y i * value (rows M i) j * x j)))
    by (intros; rewrite <- sum_scale; apply sum_ext; intros; lra).
  rewrite sum_swap. apply sum_ext. intros j _.
  rewrite (Rmult_comm (sum _ _)), <- sum_scale. apply sum_ext. intros. lra.
Qed.

(* |M x|^2 <= c |x|^2 with a c of M alone *)
Lemma dot_bound n a x : dot n a x * dot n a x <= dot n a a * dot n x x.
Proof.
  (* Cauchy and Schwarz *)
  destruct (Req_dec (dot n a a) 0) as [H0|H0].
  - assert (forall i, (i < n)%nat -> a i = 0).
    { intros i Hi. assert (H := entry_square n a i Hi). rewrite H0 in H. nra. }
    assert (E : dot n a x = 0)
      by (unfold dot; rewrite <- (sum_zero n); apply sum_ext; intros i Hi; rewrite H by auto; lra).
    rewrite E, H0. lra.
  - assert (Hp : 0 < dot n a a) by (assert (H := dot_square_nonneg n a); lra).
    set (k := dot n a x / dot n a a).
    assert (H := dot_square_nonneg n (minus x (scale k a))).
    rewrite dot_minus, (dot_comm n _ x), (dot_comm n _ (scale k a)), !dot_minus, !dot_scale in H.
    rewrite (dot_comm n (scale k a) x), (dot_comm n (scale k a) a), !dot_scale, (dot_comm n x a) in H.
    assert (E : k * dot n a a = dot n a x) by (unfold k; field; auto).
    replace (k * (k * dot n a a)) with (k * dot n a x) in H by (rewrite E; auto).
    assert (0 <= dot n x x - k * dot n a x) by lra.
    rewrite <- E at 1. nra.
Qed.
