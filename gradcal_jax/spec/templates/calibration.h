/* calibration of {{ comment(calibration.serial_number) }}, made by gradcal
{% for name, text in calibration.provenance.items() %}
 * {{ comment(name ~ ": " ~ text) }}
{% endfor %}
{% if calibration.simulated %}
 * SIMULATED: made from simulated data, not from a real sensor.
{% endif %}
 * measured = s + sum of map(T) * signals, s = input + sum of misalignment(T) * inputs across it; solved for the
 * inputs; frame: {{ comment(calibration.frame) }}
 * {% for name in header.inputs %}[{{ loop.index0 }}] {{ comment(name) }}{{ ", " if not loop.last }}{% endfor %}

 * temperature in degC, rates in rad/s, specific force in m/s^2. Beyond its range the values at the edge hold.
 */
#ifndef GRADCAL_CALIBRATION_H
#define GRADCAL_CALIBRATION_H

#define GRADCAL_CHANNELS {{ header.inputs | length }}
#define GRADCAL_TERMS {{ header.terms | length }}     /* the first {{ header.terms | selectattr("across") | list | length }} are misalignments */

struct gradcal_term {
    int of;                /* number of its channel */
    int signal[4];         /* factors: number of the channel from 1; 0: none; negative: its magnitude */
    float t_centre, t_inverse;   /* degC, 1/K */
    float w_centre, w_inverse;   /* rad/s, s/rad: of the gyro's own rate */
    int t_count, w_count;
    const float *c;        /* SI; powers of temperature slow, of rate fast */
};

{% for term in header.terms %}
static const float gradcal_c{{ loop.index0 }}[] = { {{- floats(term.table.ravel()) -}} };
{% endfor %}

static const struct gradcal_term gradcal_terms[GRADCAL_TERMS] = {
{% for term in header.terms %}
    { {{- term.of }}, { {{- (term.factors + [0, 0, 0, 0])[:4] | join(", ") -}} }, {{ floats(term.sides) }}, {{ term.table.shape | join(", ") }}, gradcal_c{{ loop.index0 -}} },
{% endfor %}
};

/* of each channel: lowest and highest temperature, degC, and rate, rad/s */
static const float gradcal_ranges[GRADCAL_CHANNELS][4] = {
{% for row in header.ranges %}
    { {{- floats(row) -}} }{{ "," if not loop.last }}
{% endfor %}
};

/* of the linear part at the middle of the temperatures */
static const float gradcal_inverse[GRADCAL_CHANNELS][GRADCAL_CHANNELS] = {
{% for row in header.inverse %}
    { {{- floats(row) -}} }{{ "," if not loop.last }}
{% endfor %}
};

static inline float gradcal_clip(float x, float low, float high)
{
    return x < low ? low : (x > high ? high : x);
}

/* Corrects one reading of all channels; `out` must not be `raw`. */
static inline void gradcal_correct(float temperature, const float raw[GRADCAL_CHANNELS], float out[GRADCAL_CHANNELS])
{
    for (int k = 0; k < GRADCAL_CHANNELS; k++) out[k] = 0.0f;
    for (int round = 0; round < {{ header.rounds }}; round++) {
        float along[GRADCAL_CHANNELS];    /* inputs along the axes of sensitivity: the channels' own signals */
        float error[GRADCAL_CHANNELS] = {0.0f};
        for (int k = 0; k < GRADCAL_CHANNELS; k++) along[k] = out[k];
        for (int k = 0; k < GRADCAL_TERMS; k++) {
            const struct gradcal_term *a = &gradcal_terms[k];
            const float *range = gradcal_ranges[a->of];
            const float x = (gradcal_clip(temperature, range[0], range[1]) - a->t_centre) * a->t_inverse;
            const float w = (gradcal_clip(along[a->of], range[2], range[3]) - a->w_centre) * a->w_inverse;
            float value = 0.0f;
            for (int i = a->t_count - 1; i >= 0; i--) {
                float row = 0.0f;
                for (int j = a->w_count - 1; j >= 0; j--) row = row * w + a->c[i * a->w_count + j];
                value = value * x + row;
            }
            for (int j = 0; j < 4; j++) {
                const int s = a->signal[j];
                if (s == 0) continue;
                const int number = (s < 0 ? -s : s) - 1;
                const float signal = number == a->of ? along[number] : out[number];
                value *= s < 0 && signal < 0.0f ? -signal : signal;
            }
            error[a->of] += value;
            if (k < {{ header.terms | selectattr("across") | list | length }}) along[a->of] += value;
        }
        for (int k = 0; k < GRADCAL_CHANNELS; k++) error[k] = raw[k] - out[k] - error[k];
        for (int k = 0; k < GRADCAL_CHANNELS; k++) {
            for (int j = 0; j < GRADCAL_CHANNELS; j++) out[k] += gradcal_inverse[k][j] * error[j];
        }
    }
}

/* self-test: gradcal_correct(GRADCAL_TEST_T, raw, out) must give these within GRADCAL_TEST_TOLERANCE */
#define GRADCAL_TEST_T {{ floats(temperature) }}
static const float gradcal_test_raw[GRADCAL_CHANNELS] = { {{- floats(raw) -}} };
static const float gradcal_test_out[GRADCAL_CHANNELS] = { {{- floats(out) -}} };
#define GRADCAL_TEST_TOLERANCE {{ floats(tolerance) }}

#endif
