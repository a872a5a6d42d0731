(* @name@: the gains of a certificate for the spec with SHA-256
   @spec@@replaced@.
   Its numbers stand here over the denominator D, exactly as they are written there.
@centres@   @files@ are compiled before, in this order. *)
From Coq Require Import Reals List.
From Bignums Require Import BigZ.
Require Import @theory@.
Import ListNotations.
Open Scope bigZ_scope.
Open Scope list_scope.  (* where [a] is a list *)

Definition D := @D@.
@numbers@

(* (8) by P, with d times its inverse, at the rate alpha / D *)
@P@
Definition alpha := @controller@.
Lemma controller : controller_proved @n@ D alpha A B K P W d = true.
Proof. vm_cast_no_check (eq_refl true). Qed.

(* (9) by Q, at the rate beta / D *)
@Q@
Definition beta := @observer@.
Lemma observer : observer_proved @N@ D beta @seen@ C L Q = true.
Proof. vm_cast_no_check (eq_refl true). Qed.
@converges@
Open Scope R_scope.

@tracks@@forgets@
Definition all := (@theorems@).
Print Assumptions all.
