function wrong = @name@_replay()
% Step the controller through @name@.mat and return how many inputs are off by a bit or more.
known = load(fullfile(fileparts(mfilename('fullpath')), '@name@.mat'));
vector = known.vector;
u = zeros(size(vector.u));
state = @name@_init();
for k = 1:size(vector.y, 1)
    [u(k, :), state] = @name@_step(state, vector.y(k, :)@w@);
end
wrong = sum(any(num2hex(u(:)) ~= num2hex(vector.u(:)), 2));
end
