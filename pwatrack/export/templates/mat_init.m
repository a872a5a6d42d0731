function state = @name@_init()
@about@
%
% state = @name@_init() is where it starts: do this once.
% [u, state] = @name@_step(state, y@ref@) runs it once, on what is measured now; u is to be put out now.
% state.status is 0; 1: the reference has ended; -1: not finite, nothing was changed, and the last input is held;
% -2: the state was overwritten, and u is 0.
% state.cell and state.cell_d are the cells of x_hat and x_d, from 0; state.x_d is the desired state.
% @name@_replay() steps it through what @name@.mat has of the simulation, and counts what is off by a bit.
t = @name@_tables();
@zeros@
@begin@
end
