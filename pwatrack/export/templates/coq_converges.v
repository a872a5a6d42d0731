
(* (17) by P_eta, at the rate gamma / D *)
@P_eta@
Definition gamma := @generator@.
Lemma generator : observer_proved @r@ D gamma A_eta [] [] P_eta = true.
Proof. vm_cast_no_check (eq_refl true). Qed.
