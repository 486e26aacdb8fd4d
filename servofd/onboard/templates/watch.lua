--[[
   {{ file }}: tells which servo of {{ aircraft or "this aircraft" }} does not follow its command.

   Made by `servofd onboard` {{ version }} for ArduPilot 4.6 or newer with servo feedback. It reads outputs and positions,
   sends text and logs SFD messages; it never commands anything.

   Copy it to APM/scripts on the SD card, set SCR_ENABLE = 1 (and SCR_HEAP_SIZE = 100000 or more) and reboot.
   Parameters, to be seen after that:
     SFD_STREAM_HZ  how often each position is sent to the ground, as SRVP1, SRVP2, ... [Hz]; 0: never
     SFD_CHECK      arming is refused: 0 never, 1 while a servo does not follow, 2 until all have moved and followed

   For each surface a model of the healthy servo runs beside the real one. What differs passes a filter that a healthy
   servo leaves at zero whatever the command; more than the threshold is an alarm. `servofd audit` does the same.
--]]

-- Angles in degrees, rates in degrees per second (up, down, and of the slowest motor tolerated), times in microseconds.
-- A tolerance is { gain, delay [s], lags, offset }. With 64 settings and states in all a surface takes 1.3 kB, with more 2.6.
-- Each mode of a servo is { decay [1/s], turn [rad/s], weight, weight of the turning part }; behind these four stand its
-- state (5, and 6 for the turning part) and that of the same mode while it follows the activity of the command (7, 8).
local SURFACES = {
{%- for surface in plan.surfaces %}
   { {{ surface | lua_entry }} },
{%- endfor %}
}

local PERIOD_MS, TURNS = {{ plan.period_ms }}, {{ plan.turns }} -- each surface is looked at once a period, some of them at each turn

local CRITICAL, WARNING, INFO = 2, 4, 6
local exp, cos, sin, abs, max, min = math.exp, math.cos, math.sin, math.abs, math.max, math.min
local NAN = 0.0 / 0.0

local PIECE_S, MOST_PIECES = 0.004, 6.0 -- while a rate limit acts, its instants are looked for piece by piece
local PEAK_HOLD_S = 0.15      -- how long the activity of the command counts
local BLANKING = 8.0          -- time constants of the filter until it has forgotten how it was started
local QUIET_US = 800000       -- an alarm is disproved within so long by a model that moves by 1.5 thresholds or more
local FOLLOWED = 0.45         -- while the residual is quiet and what it leaves moves by less than this share of that
local SILENCE_US, FROZEN_US, THAW_US = 1000000, 30000, 100000

-- What a mode is worth while it is worked on; nothing is allocated in flight.
local keep_re, keep_im, polynomial, weights = {}, {}, {}, {}
for k = 1, 9 do
   keep_re[k], keep_im[k], polynomial[k], weights[k] = 0.0, 0.0, 0.0, 0.0
end

-- ---------------------------------------------------------------- the healthy servo

-- Where the linear motion from p0 to p1, with rates v0 and v1, is at a share t of the step.
local function between(t, p0, v0, p1, v1, step)
   return p0 + t * t * (3.0 - 2.0 * t) * (p1 - p0) + t * (1.0 - t) * step * ((1.0 - t) * v0 - t * v1)
end

-- A rate-limited output follows the linear motion; its direction is 0 unless it runs at a limit.
local function follow(position, direction, up, down, p0, v0, p1, v1, step)
   local from, gap = 0.0, 0.0
   if direction == 0 then
      if v1 <= up and v1 >= -down and v0 <= up and v0 >= -down then
         return p1, 0
      end
      direction = (v1 > up or v0 > up) and 1 or -1
      position = p0
   else
      gap = min((position - p0) * direction, 0.0)
   end
   local rate = direction > 0 and up or -down
   if gap == 0.0 and (v0 - rate) * direction < 0.0 then -- it becomes too fast on the way
      from = step * (rate - v0) / (v1 - v0)
      position = between(from / step, p0, v0, p1, v1, step)
   end
   local reached = position + rate * (step - from)
   local ahead = (reached - p1) * direction
   if ahead <= 0.0 then
      return reached, direction
   end
   -- It meets the linear motion. If that runs too fast the other way by then, it turns round and follows that.
   local early, late, meet = from, step, step
   for _ = 1, 3 do
      meet = early + (late - early) * gap / (gap - ahead)
      local open = (position + rate * (meet - from) - between(meet / step, p0, v0, p1, v1, step)) * direction
      if open > 0.0 then
         late, ahead = meet, open
      else
         early, gap = meet, open
      end
   end
   local turned = v0 + (v1 - v0) * meet / step
   if turned <= up and turned >= -down then
      return p1, 0
   end
   direction = turned > 0.0 and 1 or -1
   reached = position + rate * (meet - from) + (direction > 0 and up or -down) * (step - meet)
   if (reached - p1) * direction > 0.0 then
      return p1, 0
   end
   return reached, direction
end

-- Move the model on to a later instant, under the command that it holds.
local function move(s, until_us)
   local step = (until_us - s.at_us) * 1e-6
   if step <= 0.0 then
      return
   end
   s.at_us = until_us
   local modes, held, rates, pieces = s.modes, s.held, s.rates, 1
   local limited = rates and (s.direction ~= 0 or s.weak_direction ~= 0 or s.fastest > rates[3])
   if limited then
      pieces = min(step // PIECE_S + 1.0, MOST_PIECES)
      step = step / pieces
   end
   local p0, v0, p1, v1 = 0.0, 0.0, 0.0, 0.0
   for k = 1, #modes do
      local m = modes[k]
      local decay, turn, re, im = m[1], m[2], m[5] - held, m[6]
      local keep = exp(-decay * step)
      keep_re[k], keep_im[k] = keep * cos(turn * step), -keep * sin(turn * step)
      if limited then
         p0 = p0 + m[3] * m[5] - m[4] * im
         v0 = v0 - m[3] * (decay * re - turn * im) + m[4] * (decay * im + turn * re)
      end
   end
   local position, direction, weak, weak_direction = s.position, s.direction, s.weak_position, s.weak_direction
   for _ = 1, pieces do
      p1, v1 = 0.0, 0.0
      for k = 1, #modes do
         local m = modes[k]
         local re, im, keep, turned = m[5] - held, m[6], keep_re[k], keep_im[k]
         re, im = keep * re - turned * im, keep * im + turned * re
         m[5], m[6] = held + re, im
         p1 = p1 + m[3] * m[5] - m[4] * im
         if limited then
            local decay, turn = m[1], m[2]
            v1 = v1 - m[3] * (decay * re - turn * im) + m[4] * (decay * im + turn * re)
         end
      end
      if limited then
         position, direction = follow(position, direction, rates[1], rates[2], p0, v0, p1, v1, step)
         weak, weak_direction = follow(weak, weak_direction, rates[3], rates[3], p0, v0, p1, v1, step)
         p0, v0 = p1, v1
      else
         position, weak = p1, p1
      end
   end
   s.position, s.direction, s.weak_position, s.weak_direction = position, direction, weak, weak_direction
end

-- The model holds a command from now on; its linear motion will not be faster than this.
local function hold(s, command)
   s.held = command
   local fastest = 0.0
   for k = 1, #s.modes do
      local m = s.modes[k]
      local re, im = m[5] - command, m[6]
      local rate, rate_im = m[1] * re - m[2] * im, m[1] * im + m[2] * re
      fastest = fastest + abs(m[3] * rate - m[4] * rate_im) + abs(m[3] * rate_im + m[4] * rate)
   end
   s.fastest = fastest
end

-- Commands reach the servo a delay after they were given.
local function arrive(s, now_us)
   local due = s.due
   while s.first < s.last do
      local k = 2 * (s.first % (#due // 2))
      if now_us - due[k + 1] < 0 then
         return
      end
      if s.at_us then
         move(s, due[k + 1])
      end
      hold(s, due[k + 2])
      s.first = s.first + 1
   end
   s.first, s.last = 0, 0
end

-- Start the model at rest where the surface was measured.
local function settle(s, now_us, measured)
   local rest, total = measured, 0.0
   for k = 1, #s.modes do
      total = total + s.modes[k][3]
   end
   rest = measured / total
   for k = 1, #s.modes do
      s.modes[k][5], s.modes[k][6] = rest, 0.0
   end
   hold(s, s.held or rest)
   s.at_us, s.position, s.direction, s.weak_position, s.weak_direction = now_us, measured, 0, measured, 0
   s.filter_us = nil
end

-- ---------------------------------------------------------------- the residual filter

-- Shares of the lags for this step: the characteristic polynomial of the servo, written in the lag of the filter.
local function weigh(s, step, lag)
   local n, free = 1, s.dc_gain
   polynomial[1] = 1.0
   for k = 1, #s.modes do
      local m = s.modes[k]
      local ratio = exp((s.pole - m[1]) * step)
      if m[2] == 0.0 then
         local rest = 1.0 - ratio
         polynomial[n + 1] = ratio * polynomial[n]
         for j = n, 2, -1 do
            polynomial[j] = rest * polynomial[j] + ratio * polynomial[j - 1]
         end
         polynomial[1] = rest * polynomial[1]
         n = n + 1
         free = free * (1.0 - ratio * lag)
      else
         local c, d = ratio * cos(m[2] * step), ratio * sin(m[2] * step)
         local none, one, two = (1.0 - c) * (1.0 - c) + d * d, 2.0 * (c - ratio * ratio), ratio * ratio
         polynomial[n + 1], polynomial[n + 2] = 0.0, 0.0
         for j = n + 2, 3, -1 do
            polynomial[j] = none * polynomial[j] + one * polynomial[j - 1] + two * polynomial[j - 2]
         end
         polynomial[2] = none * polynomial[2] + one * polynomial[1]
         polynomial[1] = none * polynomial[1]
         n = n + 2
         free = free * ((1.0 - c * lag) * (1.0 - c * lag) + d * lag * d * lag)
      end
   end
   local scale = 1.0 / free
   for j = 1, n do
      weights[n + 1 - j] = polynomial[j] * scale
      scale = scale * (1.0 - lag)
   end
end

-- Pass a value through the lags that begin behind `first`.
local function filter(lags, first, count, lag, value)
   local new, sum = 1.0 - lag, 0.0
   for j = 1, count do
      value = lag * lags[first + j] + new * value
      lags[first + j] = value
      sum = sum + weights[j] * value
   end
   return sum
end

-- ---------------------------------------------------------------- the threshold

-- Noise of the position, from second differences of what the model cannot explain, and the step of its reading.
local function listen(s, measured, off)
   local change = abs(measured - s.last_measured)
   if change > 0.0 and (s.resolution == 0.0 or change < s.resolution) then
      s.resolution = change
   end
   s.last_measured = measured
   local curve = abs(off - 2.0 * s.before + s.before_that)
   if curve == curve then
      s.count = s.count + 1.0
      local pace = max(1.0 / (1.0 + 0.1 * s.count), 0.001)
      s.seen_noise = max(s.seen_noise + pace * (min(curve * 0.51166336, 5.0 * s.seen_noise) - s.seen_noise), 0.001)
   end
   s.before_that, s.before = s.before, off
end

-- Largest residual that a healthy servo may leave: tolerances times the recent activity of the command, and noise.
-- `still` is what a surface that never moved would leave, `weak` what one with the slowest motor tolerated would.
local function allowed(s, still, weak, step, fresh)
   local modes = s.modes
   local fade = 1.0 / (1.0 + step / PEAK_HOLD_S)
   s.peak_weak = max(abs(weak), fade * s.peak_weak)
   if s.threshold then
      return s.threshold + s.peak_weak
   end
   if fresh then
      s.activity = still
      for k = 1, #modes do
         modes[k][7], modes[k][8] = still, 0.0
      end
   end
   local tolerance, speed, quickness, ahead = s.tolerance, 0.0, 0.0, 0.0
   if step > 0.0 then
      speed = (still - s.activity) / step
      ahead = 0.5 * (1.0 + tolerance[2] / step)
   end
   local both = still + s.activity
   for k = 1, #modes do
      local m = modes[k]
      local h, g = 0.5 * step * m[1], 0.5 * step * m[2]
      local re = (1.0 - h) * m[7] + g * m[8] + h * both
      local im = (1.0 - h) * m[8] - g * m[7] + g * both
      local size = (1.0 + h) * (1.0 + h) + g * g
      m[7], m[8] = (re * (1.0 + h) + im * g) / size, (im * (1.0 + h) - re * g) / size
      quickness = quickness + (g == 0.0 and 1.0 or 2.0) * (still - m[7])
   end
   s.peak = max(abs(still), fade * s.peak)
   s.peak_speed = max(abs(speed) + ahead * abs(speed - s.speed), fade * s.peak_speed)
   s.peak_quick = max(abs(quickness) + ahead * abs(quickness - s.quickness), fade * s.peak_quick)
   s.activity, s.speed, s.quickness = still, speed, quickness
   local noise = s.count >= 200.0 and s.seen_noise or max(s.seen_noise, s.noise)
   return tolerance[1] * s.peak + tolerance[2] * s.peak_speed + tolerance[3] * s.peak_quick + tolerance[4] + s.peak_weak
      + s.sigmas * max(noise, 0.28867513 * s.resolution)
end

-- ---------------------------------------------------------------- alarms

-- The surface that alarmed last, until it has a name or 2 s are over: what it did, and what was asked of it.
local suspect, since_us = nil, 0
local low, high, low_asked, high_asked, low_off, high_off = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
local path, towards, path_asked, turned_at, asked_at = 0.0, 0.0, 0.0, 0.0, 0.0
local first, first_asked, count, sum, sum_asked, squares, squares_asked, products = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0

local function name_it(s, now_us, measured, simulated, residual, level)
   local off, age_us = measured - simulated, now_us - since_us
   if age_us < 400000 then -- a hardover is still on its way
      low, high, low_asked, high_asked, low_off, high_off = measured, measured, simulated, simulated, off, off
      path, towards, path_asked, turned_at, asked_at = 0.0, 0.0, 0.0, measured, simulated
      first, first_asked, count, sum, sum_asked, squares, squares_asked, products =
         measured, simulated, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
      return
   end
   low, high, low_off, high_off = min(low, measured), max(high, measured), min(low_off, off), max(high_off, off)
   low_asked, high_asked = min(low_asked, simulated), max(high_asked, simulated)
   local noise = 4.0 * s.seen_noise + s.resolution
   local change, change_asked = measured - turned_at, simulated - asked_at
   if abs(change) > noise then
      path, turned_at = path + abs(change), measured
      towards = towards + (s.held > measured and change or -change)
   end
   if abs(change_asked) > noise then
      path_asked, asked_at = path_asked + abs(change_asked), simulated
   end
   local m, a = measured - first, simulated - first_asked
   count, sum, sum_asked = count + 1.0, sum + m, sum_asked + a
   squares, squares_asked, products = squares + m * m, squares_asked + a * a, products + m * a
   local asked = high_asked - low_asked
   if asked < max(3.0 * level, 3.0 * noise) and age_us < 1900000 then
      return
   end
   suspect = nil
   local middle, together, kind, size = 0.5 * (low + high), products - sum * sum_asked / count, nil, 0.0
   local apart = (squares - sum * sum / count) * (squares_asked - sum_asked * sum_asked / count)
   if high - low <= 1.5 * noise then
      if middle >= 0.9 * s.reach_high or middle <= 0.9 * s.reach_low then
         kind, size = "%s hardover %.1f deg", middle
      elseif asked >= max(level, 2.0 * noise) then
         kind, size = "%s stuck %.1f deg", middle
      end
   elseif high_off - low_off <= max(1.5 * noise, 0.25 * asked) and abs(residual) >= 0.5 * level then
      kind, size = "%s offset %+.1f deg", 0.5 * (low_off + high_off)
   elseif path > 0.0 and towards >= 0.85 * path and path_asked > 1.3 * path then
      kind = "%s slow"
   elseif asked >= 2.0 * level and together * together < 0.25 * apart then
      kind = "%s floating"
   end
   -- A fault that lasts is named again only where the surface does not move at all any more.
   if kind and (s.alarm == true or (high - low <= 1.5 * noise and kind ~= s.alarm)) then
      gcs:send_text(CRITICAL, string.format(kind, s.name, size))
      s.alarm = kind
   elseif s.alarm == true then
      s.alarm = ""
   end
end

-- By output: its last reading, when that changed, and, while alarms are held back, 1, or 2 if it was off since.
-- Readings that all stand still are no fault of one servo: drivers repeat the last ones of a frozen bus (Volz: for 5 s).
local reading, changed_us, held_back = {}, {}, {}
local bus_told, thawed_us = false, 0

-- Whether all readings stand still: that is waited for a second, and is the bus if more than one servo is off by then.
local function frozen(suspected, now_us)
   local still_us, off = SILENCE_US, 0
   for i = 1, #SURFACES do
      still_us = min(still_us, now_us - changed_us[SURFACES[i].output])
   end
   if still_us < FROZEN_US or #SURFACES < 2 then -- a bus begins again one servo after the other
      return held_back[suspected.output] > 0 and now_us - thawed_us < THAW_US
   end
   for i = 1, #SURFACES do
      local s = SURFACES[i]
      held_back[s.output] = max(held_back[s.output], abs(s.row) >= s.persistence and 2 or 1)
      off = off + held_back[s.output] - 1
   end
   if still_us == SILENCE_US and off > 1 and not bus_told then
      bus_told = true
      gcs:send_text(WARNING, "servos: positions stand still")
   end
   return still_us < SILENCE_US or off > 1
end

-- Raise an alarm, or take it back once the surface has followed its command quietly.
local function decide(s, now_us, residual, level, measured, simulated)
   s.typical = s.typical + (level - s.typical) / (1.0 + min(s.count, 1000.0))
   local size, off, quiet = abs(residual), measured - simulated, s.quiet
   quiet[2], quiet[3] = min(quiet[2], simulated), max(quiet[3], simulated)
   quiet[4], quiet[5] = min(quiet[4], off), max(quiet[5], off)
   if size >= 0.5 * level or now_us - quiet[1] >= QUIET_US then
      local asked = quiet[3] - quiet[2]
      if s.alarm and size < 0.5 * level and asked >= 1.5 * max(s.threshold or s.typical, level)
         and quiet[5] - quiet[4] <= FOLLOWED * asked then
         s.alarm = false
         gcs:send_text(WARNING, s.name .. " follows again")
      end
      quiet[1], quiet[2], quiet[3], quiet[4], quiet[5] = now_us, simulated, simulated, off, off
   end
   local side = size < level and 0 or residual > 0.0 and 1 or -1
   s.row = s.row * side > 0 and s.row + side or side
   if abs(s.row) >= s.persistence and not s.alarm and not frozen(s, now_us) then
      s.alarm, suspect, since_us = true, s, now_us
      gcs:send_text(CRITICAL, string.format("%s off by %+.1f deg", s.name, off))
   elseif s.alarm and not suspect and abs(s.row) >= s.persistence then -- has something worse followed?
      suspect, since_us = s, now_us
   end
   if suspect == s then
      name_it(s, now_us, measured, simulated, residual, level)
   end
end

-- ---------------------------------------------------------------- one position

local function judge(s, now_us, measured, simulated, weak)
   local off, lags, count = measured - simulated, s.lags, #s.lags // 3
   local fresh = not s.filter_us
   local residual, still, slower, step = off / s.dc_gain, -simulated / s.dc_gain, (weak - simulated) / s.dc_gain, 0.0
   if fresh then
      s.start_us, s.before, s.before_that = now_us, NAN, NAN
      for j = 1, count do
         lags[j], lags[count + j], lags[2 * count + j] = off, -simulated, weak - simulated
      end
   else
      step = (now_us - s.filter_us) * 1e-6
      local lag = exp(-s.pole * step)
      weigh(s, step, lag)
      residual, still = filter(lags, 0, count, lag, off), filter(lags, count, count, lag, -simulated)
      slower = s.rates and filter(lags, 2 * count, count, lag, weak - simulated) or 0.0
   end
   s.filter_us = now_us
   listen(s, measured, off)
   local level = allowed(s, still, slower, step, fresh)
   if s.start_us and (now_us - s.start_us) * 1e-6 * s.pole >= BLANKING then
      s.start_us = nil
   end
   if not s.start_us then
      decide(s, now_us, residual, level, measured, simulated)
   else
      residual = NAN
   end
   logger:write("SFD", "I,Cmd,Sim,Pos,Res,Thr", "Bfffff", "#ddddd", "------", s.output, s.command, simulated, measured,
                residual, level)
end

-- How many of the positions that wait are glitches; nil while that is not known.
local function glitches(s)
   local noise, away, back = max(s.seen_noise, 0.05), 0, 0
   for k = 1, 4 * s.waiting, 4 do
      local far = abs(s.jump[k + 1] - s.jump[k + 2] - s.before)
      if back == 0 and far > 10.0 * noise then
         away = away + 1
         if away > 2 then
            return 0
         end
      elseif far <= 8.0 * noise then
         back = back + 1
         if back == 2 then
            return away
         end
      else
         return 0
      end
   end
end

-- A position that jumps away once or twice and back is no motion: up to three more are awaited to know.
local function look(s, now_us, measured)
   local simulated, weak, stops = s.position, s.weak_position, s.stops
   if stops then
      simulated, weak = min(max(simulated, stops[1]), stops[2]), min(max(weak, stops[1]), stops[2])
   end
   if s.waiting == 0 then
      local noise = max(s.seen_noise, 0.05)
      if s.count < 8.0 or not s.filter_us or abs(measured - simulated - s.before) <= 10.0 * noise
         or abs(s.before - s.before_that) > 8.0 * noise or s.glitches >= max(0.02 * s.count, 2.0) then
         judge(s, now_us, measured, simulated, weak)
         return
      end
   end
   local jump, k = s.jump, 4 * s.waiting + 1
   jump[k], jump[k + 1], jump[k + 2], jump[k + 3] = now_us, measured, simulated, weak
   s.waiting = s.waiting + 1
   local wrong = s.draining and 0 or glitches(s)
   if not wrong then
      return
   end
   s.glitches = s.glitches + wrong
   local first = 4 * wrong
   for _ = 1, 2 do -- no call may take too long: the others follow with the next position
      if first < 4 * s.waiting then
         judge(s, jump[first + 1], jump[first + 2], jump[first + 3], jump[first + 4])
         first = first + 4
      end
   end
   for i = first + 1, 4 * s.waiting do
      jump[i - first] = jump[i]
   end
   s.waiting = s.waiting - first // 4
   s.draining = s.waiting > 0
end

-- ---------------------------------------------------------------- one surface

local sending = false
local sent_us, between_us = 0, 40000

local function hear(s, now_us, telemetry)
   local command
   if s.telemetry then
      command = telemetry and telemetry:command_position()
   else
      command = SRV_Channels:get_output_pwm_chan(s.output - 1)
      command = command and command > 0 and command - 1500
   end
   if s.command and now_us - s.heard_us > s.gap_us then
      s.at_us, s.command = nil, nil -- nobody knows what the servo did meanwhile
   end
   if not command then
      return
   end
   local deg, curve, bounds = s.gain * command + s.offset, s.curve, s.bounds
   if curve then
      deg = deg + command * command * (curve[1] + command * curve[2])
   end
   if bounds then
      deg = min(max(deg, bounds[1]), bounds[2])
   end
   if deg ~= s.command then
      local k = 2 * (s.last % (#s.due // 2))
      s.due[k + 1], s.due[k + 2] = now_us + s.delay_us, deg
      s.last = s.last + 1
   end
   s.command, s.heard_us = deg, now_us
   s.lowest, s.highest = min(s.lowest, deg), max(s.highest, deg)
end

local function watch(s, now_us)
   local telemetry = servo_telem:get_telem(s.output - 1)
   hear(s, now_us, telemetry)
   arrive(s, now_us)
   if s.filter_us and now_us - s.filter_us > s.gap_us and s.waiting == 0 then
      s.filter_us = nil -- the filter starts anew with the next position
   end
   if not telemetry then
      return
   end
   local update_ms, raw = telemetry:last_update_ms():toint(), telemetry:measured_position()
   if not raw or raw ~= raw or update_ms == s.update_ms then
      return
   end
   s.update_ms, s.seen_us, s.silent = update_ms, now_us, false
   local output = s.output
   if raw ~= reading[output] then
      reading[output], changed_us[output] = raw, now_us
      if held_back[output] > 0 then
         held_back[output], bus_told, thawed_us = 0, false, now_us
         s.row, s.filter_us = 0, nil -- what it did meanwhile nobody knows
      end
   end
   if sending then
      gcs:send_named_float(s.stream, raw)
   end
   if not s.command then
      return
   end
   local measured = s.sense * raw + s.zero
   if s.at_us then
      move(s, now_us)
   else
      settle(s, now_us, measured)
   end
   look(s, now_us, measured)
end

-- ---------------------------------------------------------------- all surfaces

-- Positions that stop are told once: of all servos together if all have stopped, for that is one cause.
local function silence(now_us)
   local silent, new = 0, nil
   for i = 1, #SURFACES do
      local s = SURFACES[i]
      if now_us - s.seen_us > SILENCE_US then
         silent = silent + 1
         if not s.silent then
            s.silent, new = true, s
         end
      end
   end
   if new then
      local all = silent == #SURFACES and silent > 1
      gcs:send_text(WARNING, all and "servos: no positions" or new.name .. " no position")
   end
end

-- Arming: a surface that alone is a reason to refuse, and which one.
local function refusal(check)
   for i = 1, #SURFACES do
      local s = SURFACES[i]
      if s.alarm then
         return s, "did not follow"
      elseif s.silent then
         return s, "no position"
      elseif check > 1 and s.highest - s.lowest < min(0.3 * (s.reach_high - s.reach_low), 10.0) then
         return s, "not moved by sticks"
      end
   end
end

local auth_id, refused, why, check_parameter, stream_parameter = nil, nil, "", nil, nil

local function check_arming()
   local check = check_parameter and check_parameter:get() or 0
   if check > 0 and not auth_id then
      auth_id, why = arming:get_aux_auth_id(), ""
   end
   if not auth_id then
      return
   end
   local s, reason = nil, nil
   if check > 0 then
      s, reason = refusal(check)
   end
   if s ~= refused or reason ~= why then
      refused, why = s, reason
      if s then
         arming:set_aux_auth_failed(auth_id, s.name .. " " .. reason)
      else
         arming:set_aux_auth_passed(auth_id)
      end
   end
end

local turn, calls = 0, 0

local function update()
   local now_us = micros():toint()
   if turn == 0 then
      sending = between_us > 0 and now_us - sent_us >= between_us
      sent_us = (sending or between_us == 0) and now_us or sent_us
   end
   for i = turn + 1, #SURFACES, TURNS do
      watch(SURFACES[i], now_us)
   end
   turn = (turn + 1) % TURNS
   calls = calls + 1
   if calls * PERIOD_MS >= 250 * TURNS then
      calls = 0
      silence(now_us)
      check_arming()
      local hz = stream_parameter and stream_parameter:get() or 25.0
      between_us = hz > 0.0 and 1000000 // hz - 500 * PERIOD_MS or 0
   end
end

local function protected()
   local fine, reason = pcall(update)
   if fine then
      return protected, PERIOD_MS // TURNS
   end
   gcs:send_text(CRITICAL, string.sub("servofd stopped: " .. tostring(reason), 1, 50))
end

-- ---------------------------------------------------------------- once

-- The settings at the top may have been edited by hand: say what is wrong with them now, not in flight.
local function mistake()
   if not servo_telem then
      return "needs ArduPilot 4.6 with servo telemetry"
   end
   for i = 1, #SURFACES do
      local s = SURFACES[i]
      if type(s.name) ~= "string" or #s.name < 1 or #s.name > {{ longest_name }} then
         return "name of surface " .. i .. ": 1 to {{ longest_name }} letters"
      end
      for _, key in ipairs({ "output", "gain", "offset", "sense", "zero", "delay_us", "dc_gain", "pole", "gap_us", "noise",
                             "sigmas", "persistence" }) do
         if type(s[key]) ~= "number" then
            return s.name .. ": " .. key .. " is no number"
         end
      end
      if s.threshold and type(s.threshold) ~= "number" then
         return s.name .. ": threshold is no number"
      end
      for key, count in pairs({ tolerance = 4, rates = s.rates and 3, bounds = s.bounds and 2, stops = s.stops and 2,
                                curve = s.curve and 2 }) do
         for k = 1, count or 0 do
            if type(s[key]) ~= "table" or type(s[key][k]) ~= "number" then
               return s.name .. ": " .. key .. ": " .. count .. " numbers"
            end
         end
      end
      if type(s.modes) ~= "table" or #s.modes < 1 or #s.modes > 8 then
         return s.name .. ": modes are wrong"
      end
      for _, mode in ipairs(s.modes) do
         if type(mode) ~= "table" or #mode ~= 4 or not (tonumber(mode[1]) and mode[1] > 0.0) then
            return s.name .. ": a mode is wrong"
         end
      end
   end
end

local function prepare(s, now_us)
   local lags = 1
   for k, mode in ipairs(s.modes) do
      lags = lags + (mode[2] == 0.0 and 1 or 2)
      for at = 5, 8 do
         mode[at] = 0.0
      end
   end
   s.lags, s.jump, s.due = {}, {}, {}
   for k = 1, 3 * lags do
      s.lags[k] = 0.0
   end
   for k = 1, 16 do
      s.jump[k] = 0.0
   end
   for k = 1, 2 * (s.delay_us // (PERIOD_MS * 1000) + 3) do -- commands on their way, and when they arrive
      s.due[k] = 0.0
   end
   for _, key in ipairs({ "position", "direction", "weak_position", "weak_direction", "fastest", "count", "glitches",
                          "waiting", "first", "last", "resolution", "activity", "speed", "quickness", "peak",
                          "peak_speed", "peak_quick", "peak_weak", "typical", "row" }) do
      s[key] = 0
   end
   s.quiet = { now_us, 0.0, 0.0, 0.0, 0.0 }
   s.alarm, s.silent, s.draining = false, false, false -- a table that grows in flight would have to be copied
   s.seen_us, s.last_measured, s.seen_noise, s.lowest, s.highest = now_us, NAN, s.noise, 1e9, -1e9
   s.stream = "SRVP" .. s.output
   reading[s.output], changed_us[s.output], held_back[s.output] = NAN, now_us, 0
   s.reach_low, s.reach_high = -1e9, 1e9
   if not s.telemetry then
      local a = s.gain * ((param:get("SERVO" .. s.output .. "_MIN") or 1000) - 1500.0) + s.offset
      local b = s.gain * ((param:get("SERVO" .. s.output .. "_MAX") or 2000) - 1500.0) + s.offset
      s.reach_low, s.reach_high = min(a, b), max(a, b)
   end
end

local wrong = mistake()
if wrong then
   gcs:send_text(CRITICAL, "servofd: " .. wrong)
   return
end
for i = 1, #SURFACES do
   prepare(SURFACES[i], micros():toint())
end
if param:add_table({{ plan.table_key }}, "SFD_", 2) and param:add_param({{ plan.table_key }}, 1, "STREAM_HZ", 25)
   and param:add_param({{ plan.table_key }}, 2, "CHECK", 0) then
   stream_parameter, check_parameter = Parameter("SFD_STREAM_HZ"), Parameter("SFD_CHECK")
else
   gcs:send_text(WARNING, "servofd: no room for its parameters")
end
gcs:send_text(INFO, "servofd watches " .. #SURFACES .. " servos")
return protected, PERIOD_MS // TURNS
