(* Gains and forms in whole numbers: what a computation decides, and what follows from it. *)
From Coq Require Import Reals List Lra Psatz ZArith Lia Bool.
From Bignums Require Import BigZ.
Import ListNotations.
Require Import Vectors Definite Convergence.
Open Scope R_scope.

(* Matrices of whole numbers, and those with a common denominator *)
Definition whole (M : matrix) : mat := fun i => value (rows M i).
Definition over (D : BigZ.t) (M : matrix) : mat := fun i => scale (/ #D) (value (rows M i)).
Definition ratio (a D : BigZ.t) : R := #a / #D.

Fixpoint product (n : nat) (r s : row) : BigZ.t :=
  match n, r, s with
  | S k, x :: r', y :: s' => BigZ.add (BigZ.mul x y) (product k r' s')
  | _, _, _ => 0%bigZ
  end.

Definition unit (i : nat) : row := repeat 0%bigZ i ++ [1%bigZ].

(* r and c_1 M_1 + c_2 M_2 + ... *)
Fixpoint with_rows (r c : row) (M : matrix) : row :=
  match c, M with
  | x :: c', s :: M' => with_rows (cross 1 r (BigZ.opp x) s) c' M'
  | _, _ => r
  end.

(* D^2 (A + B G + w / D), each of A, B, G over D *)
Definition shifted (n : nat) (D w : BigZ.t) (A B G : matrix) : matrix :=
  map (fun i => with_rows (cross D (rows A i) (BigZ.opp (BigZ.mul D w)) (unit i)) (rows B i) G) (seq 0 n).

Definition transposed (n : nat) (M : matrix) : matrix :=
  map (fun k => map (fun r => nth k r 0%bigZ) M) (seq 0 n).

Definition minus_unit (n : nat) : matrix := map (fun i => cross 0 [] 1 (unit i)) (seq 0 n).

(* - (M P + P M^T), row by row *)
Definition pair_product (n : nat) (a b : row * row) : BigZ.t :=
  BigZ.opp (BigZ.add (product n (fst a) (snd b)) (product n (snd a) (fst b))).

Definition lyapunov (n : nat) (M P : matrix) : matrix := triangle (pair_product n) (combine M P).

Definition all_entries (n : nat) (test : nat -> nat -> bool) : bool :=
  forallb (fun i => forallb (test i) (seq 0 n)) (seq 0 n).

Definition symmetric_entries (n : nat) (P : matrix) : bool :=
  all_entries n (fun i j => BigZ.eqb (nth j (rows P i) 0%bigZ) (nth i (rows P j) 0%bigZ)).

Definition inverse_entries (n : nat) (P W : matrix) (d : BigZ.t) : bool :=
  all_entries n (fun i j => BigZ.eqb (product n (rows P i) (rows W j)) (if Nat.eqb i j then d else 0%bigZ)).

Definition positive_form (n : nat) (P : matrix) : bool :=
  Nat.eqb (length P) n && symmetric_entries n P && definite (lyapunov n (minus_unit n) P).

(* (8) *)
Definition controller_proved (n : nat) (D w : BigZ.t) (A : list matrix) (B K P W : matrix) (d : BigZ.t) : bool :=
  BigZ.ltb 0 D && BigZ.ltb 0 d && positive_form n P && symmetric_entries n W && inverse_entries n P W d
  && forallb (fun Ai => definite (lyapunov n (shifted n D w Ai B K) P)) A.

(* (9), and (17) with no gain *)
Definition observer_proved (n : nat) (D w : BigZ.t) (A : list matrix) (C L Q : matrix) : bool :=
  BigZ.ltb 0 D && positive_form n Q && forallb (fun Ai => definite (lyapunov n (transposed n (shifted n D w Ai L C)) Q)) A.

(* What these mean *)

Lemma zero_row n (x : vec) : dot n (value []) x = 0.
Proof. unfold dot. rewrite <- (sum_zero n). apply sum_ext. intros. rewrite value_nil. ring. Qed.

Lemma value_product n r s : #(product n r s) = dot n (value r) (value s).
Proof.
  revert r s. induction n as [|n IH]; intros r s; [reflexivity|].
  destruct r as [|x r]; [|destruct s as [|y s]].
  - rewrite zero_row. reflexivity.
  - rewrite dot_comm, zero_row. reflexivity.
  - rewrite dot_first. simpl product. rewrite BigZ.spec_add, BigZ.spec_mul, plus_IZR, mult_IZR, IH. reflexivity.
Qed.

Lemma value_unit i j : value (unit i) j = if Nat.eqb i j then 1 else 0.
Proof.
  revert j. induction i as [|i IH]; intros [|j]; try reflexivity.
  - unfold unit, value. simpl. destruct j; reflexivity.
  - exact (IH j).
Qed.

Lemma value_with_rows r c M k :
  value (with_rows r c M) k = value r k + sum (length M) (fun j => value c j * value (rows M j) k).
Proof.
  revert r M. induction c as [|x c IH]; intros r [|s M]; simpl with_rows; try (simpl; ring).
  - rewrite (sum_ext _ _ (fun _ => 0)), sum_zero; [ring|]. intros. rewrite value_nil. ring.
  - rewrite IH, value_cross, BigZ.spec_opp, opp_IZR, one_is_1. simpl length. rewrite sum_first.
    change (sum (length M) (fun i => value (x :: c) (S i) * value (rows (s :: M) (S i)) k))
      with (sum (length M) (fun j => value c j * value (rows M j) k)).
    change (value (x :: c) O) with #x. change (rows (s :: M) O) with s. ring.
Qed.

Lemma rows_map n f i : (i < n)%nat -> rows (map f (seq 0 n)) i = f i.
Proof.
  intros H. unfold rows. rewrite (nth_indep _ _ (f O)) by (rewrite map_length, seq_length; auto).
  rewrite map_nth, seq_nth by auto. reflexivity.
Qed.

Lemma value_shifted n D w A B G i k : (i < n)%nat -> value (rows (shifted n D w A B G) i) k =
  #D * value (rows A i) k + #D * #w * (if Nat.eqb i k then 1 else 0)
  + sum (length G) (fun j => value (rows B i) j * value (rows G j) k).
Proof.
  intros H. unfold shifted. rewrite rows_map by auto.
  rewrite value_with_rows, value_cross, value_unit, BigZ.spec_opp, BigZ.spec_mul, opp_IZR, mult_IZR. ring.
Qed.

Lemma value_transposed n M i k : (i < n)%nat -> value (rows (transposed n M) i) k = value (rows M k) i.
Proof.
  intros H. unfold transposed. rewrite rows_map by auto. unfold value at 1.
  destruct (Nat.lt_ge_cases k (length M)) as [Hk|Hk].
  - rewrite (nth_indep _ 0%bigZ (nth i [] 0%bigZ)) by (rewrite map_length; auto).
    rewrite (map_nth (fun r => nth i r 0%bigZ)). reflexivity.
  - rewrite nth_overflow by (rewrite map_length; auto). unfold rows. rewrite (nth_overflow M) by auto.
    rewrite value_nil. reflexivity.
Qed.

Lemma value_minus_unit n i k : (i < n)%nat -> value (rows (minus_unit n) i) k = - if Nat.eqb i k then 1 else 0.
Proof.
  intros H. unfold minus_unit. rewrite rows_map by auto. rewrite value_cross, value_nil, value_unit, one_is_1.
  destruct (Nat.eqb i k); ring.
Qed.

Lemma pair_product_symmetric n a b : #(pair_product n a b) = #(pair_product n b a).
Proof.
  unfold pair_product. rewrite !BigZ.spec_opp, !BigZ.spec_add, !opp_IZR, !plus_IZR, !value_product.
  rewrite (dot_comm n (value (fst a))), (dot_comm n (value (snd a))). ring.
Qed.

Lemma lyapunov_form n M P x : length M = n -> length P = n ->
  form (lyapunov n M P) x = - 2 * dot n (transposed_times n M x) (transposed_times n P x).
Proof.
  intros HM HP. unfold lyapunov.
  rewrite (form_triangle (pair_product n) (([] : row), ([] : row))) by apply pair_product_symmetric.
  rewrite combine_length, HM, HP, Nat.min_id.
  assert (E : forall U V : matrix,
    sum n (fun i => sum n (fun j => dot n (value (rows U i)) (value (rows V j)) * (x i * x j)))
    = dot n (transposed_times n U x) (transposed_times n V x)).
  { intros U V. rewrite <- times_dot. apply sum_ext. intros i Hi.
    unfold times at 1. rewrite (dot_comm n (value (rows U i))), <- times_dot.
    unfold dot at 2. rewrite <- sum_scale. apply sum_ext. intros j Hj.
    unfold times. rewrite (dot_comm n (value (rows V j))). ring. }
  rewrite (sum_ext n _ (fun i => - sum n (fun j => dot n (value (rows M i)) (value (rows P j)) * (x i * x j))
    + - sum n (fun j => dot n (value (rows P i)) (value (rows M j)) * (x i * x j)))).
  - rewrite sum_plus.
    rewrite (sum_ext n (fun i => - _) (fun i => -1 * sum n (fun j => dot n (value (rows M i)) (value (rows P j)) * (x i * x j)))) by (intros; ring).
    rewrite (sum_ext n (fun i => - _) (fun i => -1 * sum n (fun j => dot n (value (rows P i)) (value (rows M j)) * (x i * x j)))) by (intros; ring).
    rewrite !sum_scale, !E, (dot_comm n (transposed_times n P x)). ring.
  - intros i Hi. rewrite (sum_ext n _ (fun j => -1 * (dot n (value (rows M i)) (value (rows P j)) * (x i * x j))
      + -1 * (dot n (value (rows P i)) (value (rows M j)) * (x i * x j)))).
    + rewrite sum_plus, !sum_scale. ring.
    + intros j Hj. unfold pair_product. rewrite !combine_nth by lia. simpl fst. simpl snd.
      rewrite BigZ.spec_opp, BigZ.spec_add, opp_IZR, plus_IZR, !value_product. unfold rows. ring.
Qed.

Lemma all_entries_hold n test : all_entries n test = true ->
  forall i j, (i < n)%nat -> (j < n)%nat -> test i j = true.
Proof.
  intros H i j Hi Hj. unfold all_entries in H. rewrite forallb_forall in H.
  assert (Hr := H i). rewrite forallb_forall in Hr. apply Hr; apply in_seq; lia.
Qed.

Lemma symmetric_holds n P : symmetric_entries n P = true -> symmetric n (whole P).
Proof.
  intros H i j Hi Hj. assert (E := all_entries_hold _ _ H i j Hi Hj). cbv beta in E.
  rewrite BigZ.spec_eqb, Z.eqb_eq in E. unfold whole, value. rewrite E. reflexivity.
Qed.

Lemma symmetric_transposed n P x j : symmetric n (whole P) -> (j < n)%nat ->
  transposed_times n P x j = mul n (whole P) x j.
Proof.
  intros H Hj. unfold transposed_times, mul, dot, entry. apply sum_ext. intros i Hi.
  assert (E := H i j Hi Hj). unfold whole in *. rewrite E. ring.
Qed.

Lemma positive_form_holds n P : positive_form n P = true -> length P = n /\ positive_definite n (whole P).
Proof.
  unfold positive_form. rewrite !andb_true_iff, Nat.eqb_eq. intros ((HL & HS) & HD).
  assert (Hs := symmetric_holds _ _ HS). split; auto. split; auto.
  destruct (definite_sound _ HD) as (m & Hm & HB).
  assert (HU : length (minus_unit n) = n) by (unfold minus_unit; rewrite map_length, seq_length; auto).
  assert (HT : length (lyapunov n (minus_unit n) P) = n)
    by (unfold lyapunov; rewrite length_triangle, combine_length, HU, HL; apply Nat.min_id).
  exists (m / 2). split; [lra|]. intros x. specialize (HB x). rewrite HT, lyapunov_form in HB by auto.
  rewrite (dot_ext n (transposed_times n (minus_unit n) x) (scale (-1) x) _ (mul n (whole P) x)) in HB.
  - rewrite (dot_comm n (scale (-1) x)), dot_scale, (dot_comm n (mul n (whole P) x)) in HB. lra.
  - intros j Hj. unfold transposed_times, entry, scale.
    rewrite (sum_ext n _ (fun i => -1 * ((if Nat.eqb j i then 1 else 0) * x i))).
    + rewrite sum_scale, sum_delta; auto.
    + intros i Hi. rewrite value_minus_unit by auto. rewrite Nat.eqb_sym. ring.
  - intros j Hj. apply symmetric_transposed; auto.
Qed.

Lemma length_shifted n D w A B G : length (shifted n D w A B G) = n.
Proof. unfold shifted. rewrite map_length, seq_length. reflexivity. Qed.

Lemma positive_is D : BigZ.ltb 0 D = true -> 0 < #D.
Proof. rewrite BigZ.spec_ltb, Z.ltb_lt, zero_is_0. apply IZR_lt. Qed.

Lemma shifted_times n D w A B G v i : 0 < #D -> (i < n)%nat -> times n (shifted n D w A B G) v i =
  #D * #D * (mul n (over D A) v i + mul (length G) (over D B) (mul n (over D G) v) i + ratio w D * v i).
Proof.
  intros HD Hi. unfold times, dot.
  rewrite (sum_ext n _ (fun k => #D * (value (rows A i) k * v k) + #D * #w * ((if Nat.eqb i k then 1 else 0) * v k)
    + sum (length G) (fun j => value (rows B i) j * (value (rows G j) k * v k)))).
  - rewrite !sum_plus, !sum_scale, sum_delta, sum_swap by auto.
    unfold mul, over, dot, scale, ratio.
    rewrite (sum_ext n (fun k => / #D * value (rows A i) k * v k) (fun k => / #D * (value (rows A i) k * v k))) by (intros; ring).
    rewrite (sum_ext (length G) (fun j => / #D * value (rows B i) j * _)
      (fun j => / #D * / #D * sum n (fun k => value (rows B i) j * (value (rows G j) k * v k)))).
    + rewrite !sum_scale. field. lra.
    + intros j Hj. rewrite (sum_ext n (fun k => / #D * value (rows G j) k * v k) (fun k => / #D * (value (rows G j) k * v k))) by (intros; ring).
      rewrite !sum_scale. ring.
  - intros k Hk. rewrite value_shifted by auto.
    rewrite (sum_ext (length G) (fun j => value (rows B i) j * (value (rows G j) k * v k))
      (fun j => v k * (value (rows B i) j * value (rows G j) k))) by (intros; ring).
    rewrite sum_scale. ring.
Qed.

Lemma form_bounded n M P : length M = n -> length P = n -> definite (lyapunov n M P) = true ->
  exists m, 0 < m /\ forall x, m * dot n x x <= - 2 * dot n (transposed_times n M x) (transposed_times n P x).
Proof.
  intros HM HP H. destruct (definite_sound _ H) as (m & Hm & HB). exists m. split; auto. intros x.
  specialize (HB x). rewrite lyapunov_form in HB by auto.
  replace (length (lyapunov n M P)) with n in HB; auto.
  unfold lyapunov. rewrite length_triangle, combine_length, HM, HP, Nat.min_id. reflexivity.
Qed.

Lemma controller_falls n D w A B K P : 0 < #D -> length P = n -> symmetric n (whole P) ->
  definite (lyapunov n (shifted n D w A B K) P) = true ->
  falls_dual n (whole P) (ratio w D)
    (fun e => plus (mul n (over D A) e) (mul (length K) (over D B) (mul n (over D K) e))).
Proof.
  intros HD HL HS H. destruct (form_bounded n _ P (length_shifted _ _ _ _ _ _) HL H) as (m & Hm & HB).
  assert (HDD : 0 < 2 * (#D * #D)) by nra.
  exists (m / (2 * (#D * #D))). split; [apply Rdiv_lt_0_compat; auto|]. intros z. specialize (HB z).
  rewrite <- times_dot in HB.
  rewrite (dot_ext n z z (times n (shifted n D w A B K) (transposed_times n P z)) (scale (#D * #D) (plus (plus (mul n (over D A) (mul n (whole P) z))
    (mul (length K) (over D B) (mul n (over D K) (mul n (whole P) z)))) (scale (ratio w D) (mul n (whole P) z))))) in HB.
  - rewrite dot_scale, dot_plus, dot_scale in HB. apply Rmult_le_reg_l with (2 * (#D * #D)); auto.
    replace (2 * (#D * #D) * (- (m / (2 * (#D * #D))) * dot n z z)) with (- (m * dot n z z)) by (field; lra).
    cbv beta. lra.
  - auto.
  - intros i Hi. 
    unfold scale, plus. rewrite shifted_times by auto.
    assert (E : forall j, (j < n)%nat -> transposed_times n P z j = mul n (whole P) z j)
      by (intros; apply symmetric_transposed; auto).
    rewrite (mul_ext n (over D A) (transposed_times n P z) (mul n (whole P) z)) by auto.
    rewrite (mul_ext (length K) (over D B) (mul n (over D K) (transposed_times n P z)) (mul n (over D K) (mul n (whole P) z)))
      by (intros; apply mul_ext; auto).
    rewrite E by auto. reflexivity.
Qed.

Lemma observer_falls n D w A C L Q : 0 < #D -> length Q = n -> symmetric n (whole Q) ->
  definite (lyapunov n (transposed n (shifted n D w A L C)) Q) = true ->
  falls n (whole Q) (ratio w D)
    (fun e => plus (mul n (over D A) e) (mul (length C) (over D L) (mul n (over D C) e))).
Proof.
  intros HD HL HS H.
  assert (HT : length (transposed n (shifted n D w A L C)) = n)
    by (unfold transposed; rewrite map_length, seq_length; auto).
  destruct (form_bounded n _ Q HT HL H) as (m & Hm & HB).
  assert (HDD : 0 < 2 * (#D * #D)) by nra.
  exists (m / (2 * (#D * #D))). split; [apply Rdiv_lt_0_compat; auto|]. intros e. specialize (HB e).
  rewrite (dot_ext n (transposed_times n (transposed n (shifted n D w A L C)) e) (scale (#D * #D) (plus (plus (mul n (over D A) e)
    (mul (length C) (over D L) (mul n (over D C) e))) (scale (ratio w D) e)))
    (transposed_times n Q e) (mul n (whole Q) e)) in HB.
  - rewrite (dot_comm n (scale _ _)), dot_scale, dot_plus, dot_scale, (dot_comm n (mul n (whole Q) e) e) in HB.
    apply Rmult_le_reg_l with (2 * (#D * #D)); auto.
    replace (2 * (#D * #D) * (- (m / (2 * (#D * #D))) * dot n e e)) with (- (m * dot n e e)) by (field; lra).
    cbv beta. lra.
  - intros k Hk. unfold scale, plus. rewrite <- shifted_times by auto.
    unfold transposed_times, times, dot, entry. apply sum_ext. intros i Hi.
    rewrite value_transposed by auto. ring.
  - intros. apply symmetric_transposed; auto.
Qed.

Lemma inverse_holds n P W d : 0 < #d -> symmetric n (whole W) -> inverse_entries n P W d = true ->
  forall e i, (i < n)%nat -> mul n (whole P) (mul n (over d W) e) i = e i.
Proof.
  intros Hd HS H e i Hi. unfold mul at 1, over. unfold dot.
  rewrite (sum_ext n _ (fun k => sum n (fun j => / #d * (value (rows P i) k * value (rows W j) k) * e j))).
  - rewrite sum_swap. rewrite (sum_ext n _ (fun j => (if Nat.eqb i j then 1 else 0) * e j)); [apply sum_delta; auto|].
    intros j Hj. assert (E := all_entries_hold _ _ H i j Hi Hj). cbv beta in E. rewrite BigZ.spec_eqb, Z.eqb_eq in E.
    apply (f_equal IZR) in E. rewrite value_product in E.
    rewrite (sum_ext n _ (fun k => (/ #d * e j) * (value (rows P i) k * value (rows W j) k))) by (intros; ring).
    rewrite sum_scale. fold (dot n (value (rows P i)) (value (rows W j))). rewrite E.
    destruct (Nat.eqb i j); [field; lra|]. rewrite zero_is_0. ring.
  - intros k Hk. unfold mul, dot, whole, scale. rewrite <- sum_scale. apply sum_ext. intros j Hj.
    assert (E := HS k j Hk Hj). unfold whole in E. rewrite E. ring.
Qed.

(* The theorems, for the numbers of a certificate *)

Definition slopes (D : BigZ.t) (A : list matrix) (i : nat) : mat := over D (nth i A []).
Definition offsets (D : BigZ.t) (b : matrix) (i : nat) : vec := scale (/ #D) (value (rows b i)).
Definition polyhedra (D : BigZ.t) (cells : list (list (row * BigZ.t))) (i : nat) : list halfspace :=
  map (fun h => (scale (/ #D) (value (fst h)), ratio (snd h) D)) (nth i cells []).

Theorem tracks n N D (A : list matrix) b cells B K C L G w P W d v Q :
  Nat.leb n N && BigZ.ltb 0 w && BigZ.ltb 0 v = true ->
  controller_proved n D w A B K P W d = true -> observer_proved N D v A C L Q = true ->
  exists c g, forall f x x_hat x_d u_ff disturbance noise off jumps most,
    field N (length A) (polyhedra D cells) (slopes D A) (offsets D b) f ->
    closed_loop n N (length K) (length C) (over D B) (over D K) (over D C) (over D L) (over D G)
      f x x_hat x_d u_ff disturbance noise off jumps ->
    (forall t, 0 <= t -> dot N (disturbance t) (disturbance t) + dot N (noise t) (noise t)
      + dot n (off t) (off t) <= most) ->
    forall t, 0 <= t ->
      errors n N x x_hat x_d t
        <= c * exp (- (2 * Rmin (ratio w D) (ratio v D)) * t) * errors n N x x_hat x_d 0 + g * most.
Proof.
  unfold controller_proved, observer_proved. rewrite !andb_true_iff, Nat.leb_le.
  intros ((HN & Hw) & Hv) (((((HD & Hd) & HP) & HW) & HI) & HA) ((_ & HQ) & HO).
  apply positive_is in HD, Hd, Hw, Hv. destruct (positive_form_holds _ _ HP) as (LP & PD).
  destruct (positive_form_holds _ _ HQ) as (LQ & QD). rewrite forallb_forall in HA, HO.
  apply tracking with (P := whole P) (P_inverse := over d W) (Q := whole Q); auto.
  - intros. apply inverse_holds; auto. apply symmetric_holds; auto.
  - intros i Hi. apply controller_falls; auto; [apply PD|]. apply HA, nth_In; auto.
  - intros i Hi. apply observer_falls; auto; [apply QD|]. apply HO, nth_In; auto.
  - apply Rdiv_lt_0_compat; auto.
  - apply Rdiv_lt_0_compat; auto.
Qed.

Theorem generator_converges n D (A : list matrix) w P :
  observer_proved n D w A [] [] P = true ->
  exists c, forall cells b (f : R -> vec -> vec) x y jumps,
    (forall t, field n (length A) (cells t) (slopes D A) (b t) (f t)) -> locally_finite jumps ->
    solves n f jumps x -> solves n f jumps y ->
    forall t, 0 <= t -> dot n (minus (x t) (y t)) (minus (x t) (y t))
      <= c * exp (- (2 * ratio w D) * t) * dot n (minus (x 0) (y 0)) (minus (x 0) (y 0)).
Proof.
  unfold observer_proved. rewrite !andb_true_iff. intros ((HD & HP) & HA).
  apply positive_is in HD. destruct (positive_form_holds _ _ HP) as (LP & PD). rewrite forallb_forall in HA.
  apply convergent with (P := whole P); auto. intros i Hi.
  destruct (observer_falls n D w (nth i A []) [] [] P HD LP (proj1 PD)) as (m & Hm & H); [apply HA, nth_In; auto|].
  exists m. split; auto. intros e. specialize (H e). rewrite dot_plus in H.
  assert (E : dot n (mul n (whole P) e) (mul 0 (over D []) (mul n (over D []) e)) = 0).
  { unfold mul at 2. unfold dot. simpl. rewrite (sum_ext _ _ (fun _ => 0)), sum_zero; [reflexivity|]. intros. ring. }
  simpl length in H. rewrite E in H. unfold slopes. lra.
Qed.
