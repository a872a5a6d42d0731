(* Whether a symmetric matrix of whole numbers is positive definite, decided by elimination. *)
From Coq Require Import Reals List Lra Psatz ZArith Lia.
From Bignums Require Import BigZ.
Import ListNotations.
Require Import Vectors.
Open Scope R_scope.

Notation "'#' a" := (IZR (BigZ.to_Z a)) (at level 1).

Definition first (r : row) : BigZ.t := nth 0 r 0%bigZ.

(* An upper triangle: its first row begins on the diagonal, and so does each that follows. *)
Fixpoint form (T : matrix) (x : vec) : R :=
  match T with
  | [] => 0
  | r :: T' =>
      let x' := fun i => x (S i) in
      #(first r) * (x O * x O) + 2 * x O * dot (length T') (value (tl r)) x' + form T' x'
  end.

Fixpoint cross (a : BigZ.t) (r : row) (c : BigZ.t) (s : row) : row :=
  match r, s with
  | [], _ => map (fun y => BigZ.opp (BigZ.mul c y)) s
  | _, [] => map (BigZ.mul a) r
  | x :: r', y :: s' => BigZ.sub (BigZ.mul a x) (BigZ.mul c y) :: cross a r' c s'
  end.

Fixpoint schur (a : BigZ.t) (b : row) (T : matrix) : matrix :=
  match T with [] => [] | r :: T' => cross a r (first b) b :: schur a (tl b) T' end.

(* Quotients, if all are whole: they are, by the pivot before (Bareiss), which nothing here relies on. *)
Fixpoint divided (d : BigZ.t) (r : row) : option row :=
  match r with
  | [] => Some []
  | x :: r' =>
      let (q, left) := BigZ.div_eucl x d in
      if BigZ.eqb left 0 then option_map (cons q) (divided d r') else None
  end.

Fixpoint all_divided (d : BigZ.t) (T : matrix) : option matrix :=
  match T with
  | [] => Some []
  | r :: T' =>
      match divided d r, all_divided d T' with Some q, Some Q => Some (q :: Q) | _, _ => None end
  end.

Definition reduced (d : BigZ.t) (T : matrix) : matrix := match all_divided d T with Some Q => Q | None => T end.

Fixpoint eliminate (steps : nat) (last : BigZ.t) (T : matrix) : bool :=
  match T, steps with
  | [], _ => true
  | _, O => false
  | r :: T', S k =>
      let a := first r in BigZ.ltb 0 a && eliminate k a (reduced last (schur a (tl r) T'))
  end.

Definition definite (T : matrix) : bool := eliminate (length T) 1%bigZ T.

(* What the steps mean *)

Lemma zero_is_0 : BigZ.to_Z 0%bigZ = 0%Z.
Proof. reflexivity. Qed.

Lemma one_is_1 : BigZ.to_Z 1%bigZ = 1%Z.
Proof. reflexivity. Qed.

Lemma value_nil j : value [] j = 0.
Proof. unfold value. destruct j; reflexivity. Qed.

Lemma value_tl r j : value (tl r) j = value r (S j).
Proof. destruct r; simpl; [rewrite !value_nil|]; reflexivity. Qed.

Lemma value_map f (Hf : BigZ.to_Z (f 0%bigZ) = 0%Z) r j : value (map f r) j = #(f (nth j r 0%bigZ)).
Proof.
  unfold value. destruct (Nat.lt_ge_cases j (length r)) as [H|H].
  - rewrite (nth_indep _ 0%bigZ (f 0%bigZ)) by (rewrite map_length; auto). rewrite map_nth. reflexivity.
  - rewrite !nth_overflow by (try rewrite map_length; auto). rewrite Hf. reflexivity.
Qed.

Lemma value_cross a r c s j : value (cross a r c s) j = #a * value r j - #c * value s j.
Proof.
  revert s j. induction r as [|x r IH]; intros s j.
  - simpl. rewrite value_map.
    + rewrite value_nil, BigZ.spec_opp, BigZ.spec_mul, opp_IZR, mult_IZR. unfold value.
    change BigZ.t_ with BigZ.t. ring.
    + rewrite BigZ.spec_opp, BigZ.spec_mul, zero_is_0. lia.
  - destruct s as [|y s]; simpl cross.
    + change (BigZ.mul a x :: map (BigZ.mul a) r) with (map (BigZ.mul a) (x :: r)). rewrite value_map.
      * rewrite value_nil, BigZ.spec_mul, mult_IZR. unfold value. change BigZ.t_ with BigZ.t. ring.
      * rewrite BigZ.spec_mul, zero_is_0. lia.
    + destruct j as [|j]; [|exact (IH s j)].
      unfold value. simpl. rewrite BigZ.spec_sub, !BigZ.spec_mul, minus_IZR, !mult_IZR. reflexivity.
Qed.

Lemma first_value r : # (first r) = value r O.
Proof. reflexivity. Qed.

Lemma form_schur a b T x : form (schur a b T) x =
  #a * form T x - dot (length T) (value b) x * dot (length T) (value b) x.
Proof.
  revert b x. induction T as [|r T IH]; intros b x; simpl schur; simpl form; [unfold dot; simpl; lra|].
  rewrite IH, first_value, value_cross, !first_value.
  replace (length (schur a (tl b) T)) with (length T)
    by (clear; revert b; induction T; simpl; intros; [|rewrite <- IHT]; auto).
  simpl length. rewrite !dot_first.
  rewrite (dot_ext _ (value (tl b)) (fun i => value b (S i)) _ (fun i => x (S i)))
    by (intros; try apply value_tl; auto).
  rewrite (dot_ext _ (value (tl (cross a r (first b) b))) (plus (scale #a (value (tl r))) (scale (- value b O) (fun i => value b (S i))))
    _ (fun i => x (S i))).
  - rewrite dot_comm, dot_plus, !dot_scale, (dot_comm _ _ (value (tl r))),
    (dot_comm _ _ (fun i => value b (S i))). ring.
  - intros i _. unfold plus, scale. rewrite value_tl, value_cross, value_tl, first_value. ring.
  - auto.
Qed.

Lemma value_divided d r q j : 0 < #d -> divided d r = Some q -> value r j = #d * value q j.
Proof.
  intros Hd. revert q j. induction r as [|x r IH]; simpl; intros q j H.
  - injection H as <-. rewrite value_nil. lra.
  - assert (E := BigZ.spec_div_eucl x d). destruct (BigZ.div_eucl x d) as (y & left).
    destruct (BigZ.eqb left 0) eqn:E0; [|discriminate]. rewrite BigZ.spec_eqb, Z.eqb_eq, zero_is_0 in E0.
    assert (Hz : BigZ.to_Z d <> 0%Z) by (intros Hz; rewrite Hz in Hd; lra).
    assert (F := Z.div_eucl_eq (BigZ.to_Z x) (BigZ.to_Z d) Hz). rewrite <- E, E0, Z.add_0_r in F.
    destruct (divided d r) as [p|]; [|discriminate]. injection H as <-.
    destruct j; [|exact (IH p j eq_refl)]. unfold value. simpl. rewrite F, mult_IZR. reflexivity.
Qed.

Lemma all_divided_form d T Q : 0 < #d -> all_divided d T = Some Q ->
  length Q = length T /\ forall x, form T x = #d * form Q x.
Proof.
  intros Hd. revert Q. induction T as [|r T IH]; simpl; intros Q H.
  - injection H as <-. split; auto. intros. simpl. lra.
  - destruct (divided d r) as [q|] eqn:E; [|discriminate]. destruct (all_divided d T) as [P|]; [|discriminate].
    injection H as <-. destruct (IH P eq_refl) as [HL HF]. split; [simpl; auto|]. intros x. simpl.
    rewrite HF, HL, !first_value, (value_divided _ _ _ O Hd E).
    rewrite (dot_ext _ (value (tl r)) (scale #d (value (tl q))) _ (fun i => x (S i))).
    + rewrite dot_comm, dot_scale, (dot_comm _ _ (value (tl q))). ring.
    + intros. unfold scale. rewrite !value_tl. apply value_divided; auto.
    + auto.
Qed.

Lemma form_reduced d T : 0 < #d ->
  length (reduced d T) = length T /\ exists c, 0 < c /\ forall x, form T x = c * form (reduced d T) x.
Proof.
  intros Hd. unfold reduced. destruct (all_divided d T) as [Q|] eqn:E.
  - destruct (all_divided_form _ _ _ Hd E). split; auto. exists #d. auto.
  - split; auto. exists 1. split; [lra|]. intros. lra.
Qed.

Lemma length_schur a b T : length (schur a b T) = length T.
Proof. revert b. induction T; simpl; intros; [|rewrite IHT]; auto. Qed.

(* Completing the square *)
Lemma form_square r T x :
  #(first r) * form (r :: T) x =
    (#(first r) * x O + dot (length T) (value (tl r)) (fun i => x (S i)))
    * (#(first r) * x O + dot (length T) (value (tl r)) (fun i => x (S i)))
    + form (schur (first r) (tl r) T) (fun i => x (S i)).
Proof. rewrite form_schur. simpl form. ring. Qed.

Definition bounded_below (T : matrix) := exists m, 0 < m /\ forall x, m * dot (length T) x x <= form T x.

Lemma eliminate_sound steps last T : 0 < #last -> eliminate steps last T = true -> bounded_below T.
Proof.
  revert last T. induction steps as [|k IH]; intros last [|r T] Hl H; simpl in H; try discriminate.
  1, 2: exists 1; split; [lra|]; intros; unfold dot; simpl; lra.
  destruct (BigZ.ltb 0 (first r)) eqn:E; [|discriminate]. simpl in H.
  rewrite BigZ.spec_ltb, Z.ltb_lt, zero_is_0 in E. apply IZR_lt in E.
  destruct (form_reduced last (schur (first r) (tl r) T) Hl) as (HL & c & Hc & HF).
  destruct (IH _ _ E H) as (m & Hm & HM). rewrite HL, length_schur in HM.
  set (a := #(first r)) in *. set (B := dot (length T) (value (tl r)) (value (tl r))).
  assert (HB : 0 <= B) by apply dot_square_nonneg.
  assert (Hcm : 0 < c * m) by (apply Rmult_lt_0_compat; auto).
  assert (Hai : 0 < / (a * a)) by (apply Rinv_0_lt_compat; nra).
  set (K := 2 * / (a * a) + (1 + 2 * B * / (a * a)) * / (c * m)).
  assert (Hcmi : 0 < / (c * m)) by (apply Rinv_0_lt_compat; auto).
  assert (H1 : 0 < (1 + 2 * B * / (a * a)) * / (c * m)).
  { apply Rmult_lt_0_compat; auto. assert (0 <= B * / (a * a)) by (apply Rmult_le_pos; lra). lra. }
  assert (HK : 0 < K) by (unfold K; lra).
  exists (/ (a * K)). split; [apply Rinv_0_lt_compat; nra|]. intros x.
  set (x' := fun i => x (S i)). set (X := dot (length T) x' x'). set (b := dot (length T) (value (tl r)) x').
  assert (HX : 0 <= X) by apply dot_square_nonneg.
  assert (Hb : b * b <= B * X) by apply dot_bound.
  assert (Hsq := form_square r T x). fold a x' b in Hsq. rewrite HF in Hsq. specialize (HM x'). fold X in HM.
  set (q := form (reduced last (schur (first r) (tl r) T)) x') in *.
  set (u := (a * x O + b) * (a * x O + b)) in *.
  assert (Hu : 0 <= u) by apply Rle_0_sqr.
  assert (Hq : u + c * m * X <= a * form (r :: T) x) by (rewrite Hsq; assert (c * (m * X) <= c * q)
    by (apply Rmult_le_compat_l; lra); lra).
  assert (Hx : (a * a) * (x O * x O) <= 2 * u + 2 * B * X).
  { assert (0 <= (a * x O + 2 * b) * (a * x O + 2 * b)) by apply Rle_0_sqr. unfold u. nra. }
  assert (Hx' : x O * x O <= / (a * a) * (2 * u + 2 * B * X)).
  { replace (x O * x O) with (/ (a * a) * ((a * a) * (x O * x O))) by (field; lra). apply Rmult_le_compat_l; lra. }
  assert (Hall : x O * x O + X <= K * (u + c * m * X)).
  { unfold K. replace ((2 * / (a * a) + (1 + 2 * B * / (a * a)) * / (c * m)) * (u + c * m * X))
      with (2 * / (a * a) * u + (1 + 2 * B * / (a * a)) * X
            + 2 * / (a * a) * (c * m * X) + (1 + 2 * B * / (a * a)) * / (c * m) * u) by (field; lra).
    assert (0 <= 2 * / (a * a) * (c * m * X)) by (apply Rmult_le_pos; [lra|apply Rmult_le_pos; lra]).
    assert (0 <= (1 + 2 * B * / (a * a)) * / (c * m) * u) by (apply Rmult_le_pos; lra). lra. }
  simpl length. rewrite dot_first. fold x'. fold X.
  apply Rle_trans with (/ (a * K) * (K * (u + c * m * X))).
  - apply Rmult_le_compat_l; [left; apply Rinv_0_lt_compat; nra|exact Hall].
  - replace (/ (a * K) * (K * (u + c * m * X))) with (/ a * (u + c * m * X)) by (field; lra).
    replace (form (r :: T) x) with (/ a * (a * form (r :: T) x)) by (field; lra).
    apply Rmult_le_compat_l; [left; apply Rinv_0_lt_compat; lra|exact Hq].
Qed.

Theorem definite_sound T : definite T = true -> bounded_below T.
Proof. apply eliminate_sound. rewrite one_is_1. lra. Qed.

(* And nothing that is positive definite is refused. *)
Definition positive (T : matrix) := forall x, (exists j, (j < length T)%nat /\ x j <> 0) -> 0 < form T x.

Lemma form_zero T x : (forall i, (i < length T)%nat -> x i = 0) -> form T x = 0.
Proof.
  revert x. induction T as [|r T IH]; simpl; intros x H; auto.
  rewrite IH, (H O) by (intros; try apply H; lia). ring.
Qed.

Lemma eliminate_complete T : forall last, 0 < #last -> positive T -> eliminate (length T) last T = true.
Proof.
  remember (length T) as k eqn:Hk. revert T Hk.
  induction k as [|k IH]; intros [|r T] Hk last Hl HP; simpl in Hk; try discriminate; auto.
  injection Hk as Hk. assert (Ha : 0 < #(first r)).
  { assert (H := HP (fun i => if Nat.eqb i 0 then 1 else 0)). simpl in H.
    unfold dot in H. rewrite (sum_ext _ _ (fun _ => 0)), sum_zero, form_zero in H by (intros; simpl; lra || auto).
    replace (#(first r)) with (#(first r) * (1 * 1) + 2 * 1 * 0 + 0) by ring. apply H. exists O. split; [lia|].
    simpl. lra. }
  simpl. apply Bool.andb_true_iff. split.
  - rewrite BigZ.spec_ltb, Z.ltb_lt, zero_is_0. apply lt_IZR. exact Ha.
  - destruct (form_reduced last (schur (first r) (tl r) T) Hl) as (HL & c & Hc & HF). rewrite length_schur in HL.
    apply IH; [lia|auto|]. intros x (i & Hi & Hx). rewrite HL in Hi.
    set (y := fun j => match j with O => - / #(first r) * dot (length T) (value (tl r)) x | S j => x j end).
    assert (H : 0 < form (r :: T) y) by (apply HP; exists (S i); simpl; split; [lia|auto]).
    assert (Hsq := form_square r T y). simpl (fun i => y (S i)) in Hsq. change (fun i : nat => x i) with x in Hsq.
    replace (#(first r) * y O + dot (length T) (value (tl r)) x) with 0 in Hsq by (simpl; field; lra).
    rewrite HF in Hsq. assert (0 < #(first r) * form (r :: T) y) by (apply Rmult_lt_0_compat; auto).
    apply Rmult_lt_reg_l with c; auto. lra.
Qed.

Theorem definite_complete T : positive T -> definite T = true.
Proof. apply eliminate_complete. rewrite one_is_1. lra. Qed.

(* The triangle of a symmetric table of products, and its form *)
Definition triangle {A} (g : A -> A -> BigZ.t) : list A -> matrix :=
  fix each (l : list A) := match l with [] => [] | a :: l' => map (g a) l :: each l' end.

Lemma length_triangle {A} (g : A -> A -> BigZ.t) l : length (triangle g l) = length l.
Proof. induction l; simpl; auto. Qed.

Lemma form_triangle {A} (g : A -> A -> BigZ.t) (none : A) l x : (forall a b, #(g a b) = #(g b a)) ->
  form (triangle g l) x =
    sum (length l) (fun i => sum (length l) (fun j => #(g (nth i l none) (nth j l none)) * (x i * x j))).
Proof.
  intros Hg. revert x. induction l as [|a l IH]; intros x; auto.
  change (length (a :: l)) with (S (length l)). rewrite !sum_first. simpl nth.
  simpl triangle. simpl form. rewrite IH, length_triangle.
  rewrite (sum_ext (length l) (fun i => sum (S (length l)) _)
    (fun i => #(g a (nth i l none)) * (x O * x (S i))
       + sum (length l) (fun j => #(g (nth i l none) (nth j l none)) * (x (S i) * x (S j))))).
  2: { intros i _. rewrite sum_first. simpl. rewrite (Hg _ a). f_equal. ring. }
  rewrite sum_plus.
  replace (2 * x O * dot (length l) (value (map (g a) l)) (fun i => x (S i)))
    with (2 * sum (length l) (fun i => #(g a (nth i l none)) * (x O * x (S i)))).
  - unfold first. simpl nth. ring.
  - unfold dot. rewrite (Rmult_assoc 2), <- (sum_scale _ (x O)). f_equal. apply sum_ext. intros i Hi.
    replace (value (map (g a) l) i) with #(g a (nth i l none)); [ring|].
    unfold value. rewrite (nth_indep _ 0%bigZ (g a none)) by (rewrite map_length; auto). rewrite map_nth. reflexivity.
Qed.
